"""Meaningful perturbations of parameters: changes as large as those that an optimiser makes in one iteration."""

from collections.abc import Mapping, Sequence

import numpy as np

from cortado.errors import InputError, shown
from cortado.problem import Problem
from cortado.rollout.parameter_space import ParameterSpace
from cortado.scene.parameters.parameter import Axis, Parameter, Range, Role
from cortado.scene.parameters.values import Arrays, Values

PERTURBATION = 0.05
"""Size of a meaningful perturbation, relative to that of the parameter or, for states, of the flow (`scales`)."""


def checked_parameters(problem: Problem, parameters: Values | Sequence[str]) -> Arrays:
    """The values of parameters, given as values or as names of the scene's."""
    simulation = problem.simulation
    if problem.state is not None:
        raise InputError(
            "problem begins at a state, but must begin as its scene does to be certified, as first positions and "
            "velocities are moved, too."
        )
    values = ParameterSpace(simulation, problem.steps).defaults()
    for view, other in simulation.known.views.items():
        parameter = simulation.known[view]
        led = other == "gravity" and simulation.scene.schedule.leads_gravity
        if parameter.present(simulation.scene) and not led:
            values[view] = parameter.value(simulation)
    if not isinstance(parameters, (Mapping, Sequence)) or isinstance(parameters, (str, bytes)):
        raise InputError(f"parameters is {shown(parameters)}, but must be values by name, or a list of names.")
    known = ", ".join(values)
    if isinstance(parameters, Mapping):
        values = dict(parameters)
    unknown = [name for name in parameters if not isinstance(name, str) or name not in values]
    if unknown:
        raise InputError(f"parameter {shown(unknown[0])} is unknown, but must be one of {known}.")
    if not parameters:
        raise InputError(f"parameters is empty, but must have at least one of {known}.")
    found = ParameterSpace(simulation, problem.steps).checked({name: values[name] for name in parameters})
    for name, value in found.items():
        if not _moves_both_ways(simulation.known[name], value):
            raise InputError(f"parameter {name} is 0, but must be greater than 0, so that it can be moved both ways.")
    return found


def everything(problem: Problem, chosen: Arrays) -> Arrays:
    """Every parameter of the problem that acts and that can be both increased and decreased, with its values.

    Values are the chosen ones, else the scene's, as its schedule has them; parameters over time have a row for each
    step. A viscosity of 0 cannot be decreased and is left out; so is a mobility in a scene of one phase, where it does
    nothing.
    """
    values = {**ParameterSpace(problem.simulation, problem.steps).defaults(), **chosen}
    found = {}
    for name, value in values.items():
        parameter = problem.simulation.known[name]
        over_time = parameter.axis is Axis.STEP
        idle = over_time and problem.steps == 0
        idle = idle or any(view in chosen and name == other for view, other in problem.simulation.known.views.items())
        idle = idle or not _moves_both_ways(parameter, value)
        if idle or not parameter.acts(problem.simulation, values):
            continue
        row = value.shape[value.ndim - parameter.rank :]
        found[name] = np.broadcast_to(value, (problem.steps, *row)).copy() if over_time else value
    return found


def _moves_both_ways(parameter: Parameter, value: np.ndarray) -> bool:
    """Whether no number of a parameter is at the end of its range."""
    return parameter.range is not Range.NOT_NEGATIVE or bool((value > 0.0).all())


def scales(problem: Problem, values: Arrays, perturbation: float = PERTURBATION) -> Arrays:
    """The size of a meaningful perturbation of every number of these parameters, in their shapes and units.

    It is a part of the parameter's value; of the spacing for positions, of the speed of a fall for velocities.
    """
    known = problem.simulation.known
    return {
        name: np.broadcast_to(perturbation * known[name].change(problem.simulation, value), value.shape)
        for name, value in values.items()
    }


def directions(values: Arrays, sizes: Arrays, random: np.random.Generator) -> Arrays:
    """For every parameter a random direction of the given size; one that is a single number is increased."""
    return {
        name: sizes[name] * (random.standard_normal(value.shape) if value.ndim else 1.0)
        for name, value in values.items()
    }


def coherent_directions(problem: Problem, values: Arrays, sizes: Arrays, random: np.random.Generator) -> Arrays:
    """Random directions that are smooth in space and constant in time, which move the fluid as a whole; of a path that
    begins at 0 they grow in time.

    An independent random number for each particle would only move particles against their neighbours.
    """
    x = problem.simulation.positions - problem.simulation.positions.mean(axis=0)
    x = x / (np.abs(x).max() or 1.0)
    found = directions(values, sizes, random)
    for name in found:
        parameter = problem.simulation.known[name]
        if parameter.axis not in (Axis.STEP, Axis.PARTICLE):
            continue
        columns = values[name].shape[values[name].ndim - parameter.rank :]
        field = random.standard_normal(columns)
        if parameter.role is Role.STATE:
            field = field + x @ random.standard_normal((x.shape[1], *columns))
        if parameter.grows and values[name].ndim > parameter.rank:
            field = np.multiply.outer(np.arange(1.0, problem.steps + 1.0) / problem.steps, field)
        found[name] = sizes[name] * field
    return found
