"""What a meaningful change of a parameter is: one that an optimiser would make."""

from collections.abc import Mapping, Sequence

import numpy as np

from cortado.controls import Controls
from cortado.errors import InputError
from cortado.parameter_values import NUMBERS, OVER_TIME, STATES, Arrays, Values
from cortado.problem import Problem

CHANGE = 0.05
"""Of a parameter, in its own size, or in that of the flow: spacings, speeds of a fall."""
FRACTIONS = 0.001
"""Of mass fractions, which have to add up to 1 within 0.01."""


def point(problem: Problem, parameters: Values | Sequence[str]) -> Arrays:
    """The values of parameters, given as values or as names of the scene's."""
    values = problem.simulation.parameters()
    if values["gravity"].any():
        values["tilt"] = np.zeros(problem.simulation.dimension - 1)
    if isinstance(parameters, Mapping):
        values = dict(parameters)
    unknown = [name for name in parameters if name not in values]
    if unknown:
        raise InputError(f"parameter {unknown[0]!r} is unknown, but must be one of {', '.join(values)}.")
    if not parameters:
        raise InputError(f"parameters is empty, but must have at least one of {', '.join(values)}.")
    return Controls(problem.simulation, problem.steps).checked({name: values[name] for name in parameters})


def everything(problem: Problem, chosen: Arrays) -> Arrays:
    """Every parameter that can be moved both ways, tables step by step, at the chosen values and else the scene's: not
    a viscosity or mobility of 0, nor what only acts between phases where there is but one."""
    values = {**problem.simulation.parameters(), **chosen}
    idle = {"mass_fractions"} if len(problem.simulation.scene.phase) == 1 else set()
    idle |= {"mobility", "interface_width"} if idle or not values["mobility"] > 0.0 else set()
    idle |= {"viscosity"} if not (values["viscosity"] > 0.0).all() else set()
    idle |= set(OVER_TIME) if problem.steps == 0 else set()
    idle |= {"gravity"} if "tilt" in chosen else set()
    found = {name: value for name, value in values.items() if name not in idle}
    for name in set(OVER_TIME) & found.keys():
        found[name] = np.broadcast_to(found[name], (problem.steps, found[name].shape[-1])).copy()
    return found


def scales(problem: Problem, values: Arrays, change: float = CHANGE) -> Arrays:
    """The size of a meaningful change of every number of these parameters."""
    simulation = problem.simulation
    spacing = simulation.scene.discretisation.spacing
    gravity = float(np.linalg.norm(simulation.scene.forces.gravity)) or 1.0
    height = float(np.ptp(simulation.positions, axis=0).max()) + spacing
    speed = np.sqrt(gravity * height)
    units = {
        "gravity": gravity,
        "tilt": np.degrees(1.0),
        "initial_positions": spacing,
        "initial_velocities": speed,
        "nozzle_path": spacing,
        "mass_fractions": FRACTIONS / CHANGE,
        "colours": 1.0,
    }
    relative = {name: np.abs(values[name]) for name in values if name in (*NUMBERS, "viscosity", "rest_density")}
    return {name: np.broadcast_to(change * (relative | units)[name], values[name].shape) for name in values}


def directions(values: Arrays, sizes: Arrays, random: np.random.Generator) -> Arrays:
    """For every parameter a random direction of such a size; numbers simply grow."""
    return {
        name: sizes[name] * (random.standard_normal(value.shape) if value.ndim else 1.0)
        for name, value in values.items()
    }


def coherent_directions(problem: Problem, values: Arrays, sizes: Arrays, random: np.random.Generator) -> Arrays:
    """The same, alike for neighbours and from step to step: what moves the fluid rather than its particles."""
    x = problem.simulation.positions - problem.simulation.positions.mean(axis=0)
    x = x / (np.abs(x).max() or 1.0)
    found = directions(values, sizes, random)
    for name in found.keys() & {*STATES, *OVER_TIME}:
        columns = values[name].shape[-1]
        field = random.standard_normal(columns)
        if name in STATES:
            field = field + x @ random.standard_normal((x.shape[1], columns))
        found[name] = sizes[name] * field
    return found
