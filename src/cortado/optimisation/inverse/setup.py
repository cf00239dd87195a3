"""The setup of a task on a device: its problem with the target, and its start in the coordinates of the search."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from cortado.errors import DivergedError, InputError
from cortado.losses import FinalPositions, Frames, Image, Loss, Snapshot
from cortado.optimisation.inverse.named_values import RANDOM
from cortado.optimisation.inverse.tables import DISTANCES
from cortado.optimisation.inverse.task import Task
from cortado.optimisation.transforms import Bijector, Logarithm, Softmax, TimeInterpolation, Transformed
from cortado.pictures.image_files import heart, read_picture, rosetta
from cortado.problem import Problem
from cortado.render.renderer import Renderer
from cortado.render.scene_renderer import scene_renderer
from cortado.scene.containers import CylinderContainer
from cortado.scene.parameter_values import Arrays
from cortado.scene.parameters import Range
from cortado.simulation import Simulation

DRAWN = {"heart": heart, "rosetta": rosetta}


@dataclass(frozen=True)
class Setup:
    """The arguments for `cortado.optimise`, and the target that its result is compared with."""

    task: Task
    problem: Problem
    searches: tuple[Transformed, ...]
    """One for each entry of the extinction schedule, in the same coordinates; the last is the scene's own."""
    start: Arrays
    """Coordinates with which the search starts."""
    bounds: dict[str, tuple[Any, Any]]
    """Lower and upper bounds of coordinates."""
    renderer: Renderer | None
    """None where positions are compared."""
    targets: dict[int, np.ndarray]
    """Images (rows, columns, 3) or positions (n, d) [m] by the number of steps before them."""

    @property
    def search(self) -> Transformed:
        """The last of the searches, that of the task itself."""
        return self.searches[-1]

    def image(self, end: Snapshot) -> np.ndarray:
        """The picture (rows, columns, 3) of a state."""
        assert self.renderer is not None
        return self.renderer.render(end.state.positions, end.state.mass_fractions, end.colours)

    def true_parameter(self, name: str) -> np.ndarray | None:
        """The parameter's value in the run that made the target; None where a picture is the target."""
        return self.task.true_parameters.get(name)


def setup(task: Task, device: str, precision: str) -> Setup:
    """The task on a device; raises `InputError` for a picture that cannot be read."""
    simulation = Simulation(task.scene, device, precision)
    start = {name: _start(name, value, simulation) for name, value in task.start.items()}
    found = _coordinates(task, start)
    searches = []
    for factor in task.optimise.extinction_schedule:
        renderer = scene_renderer(simulation, factor) if task.problem.loss == "image" else None
        targets = _targets(task, simulation, renderer)
        problem = Problem(simulation, task.problem.steps, _frames(task, targets, renderer))
        searches.append(Transformed(problem, found))
    bounds = _bounds(task)
    coordinates = searches[-1].coordinate(start)
    for name, (lower, upper) in bounds.items():
        coordinates[name] = np.clip(coordinates[name], lower, upper)  # what is random, or a little outside by round-off
    return Setup(task, problem, tuple(searches), coordinates, bounds, renderer, targets)


def _frames(task: Task, targets: dict[int, np.ndarray], renderer: Renderer | None) -> Frames:
    losses: dict[int, Loss] = {}
    for step, target in targets.items():
        if renderer is None:
            losses[step] = FinalPositions(target)
        else:
            losses[step] = Image(renderer, target, DISTANCES[task.problem.distance])
    return Frames(losses)


def _targets(task: Task, simulation: Simulation, renderer: Renderer | None) -> dict[int, np.ndarray]:
    steps = task.problem.compared
    if task.problem.picture is not None:
        assert renderer is not None
        return {steps[-1]: _picture(task, renderer)}
    nothing = FinalPositions(simulation.positions)
    try:
        ends = Problem(simulation, task.problem.steps, nothing).states(task.true_parameters, steps)
    except DivergedError as error:
        run = "this is the run that makes the target, with the parameters of problem.target"
        raise error.with_advice(f"{run}; {error.advice}, or change those") from None
    except InputError as error:
        raise InputError(f"problem.target: {error}") from None
    if renderer is None:
        return {step: end.positions for step, end in ends.items()}
    return {
        step: renderer.render(end.state.positions, end.state.mass_fractions, end.colours) for step, end in ends.items()
    }


def _picture(task: Task, renderer: Renderer) -> np.ndarray:
    """The picture that a task names; "heart" and "rosetta" are drawn in the scene's colours, the last phase on the
    first."""
    name, scene = task.problem.picture, task.scene
    assert name is not None
    rows, columns, _ = renderer.shape
    if name not in DRAWN:
        return read_picture(task.folder / name, (columns, rows))
    colours = [phase.colour for phase in scene.phase]
    background = scene.render.background if scene.render else (1.0, 1.0, 1.0)
    under = colours[0] if len(colours) > 1 else background
    cup = 1.0 if isinstance(scene.container, CylinderContainer) else None
    options: dict[str, Any] = {"milk": colours[-1], "coffee": under, "background": background}
    return DRAWN[name]((columns, rows), cup=cup, **options)


def _start(name: str, value: Any, simulation: Simulation) -> np.ndarray:
    if not isinstance(value, str) or value != RANDOM:
        return np.asarray(value)
    random = np.random.default_rng(0)
    if name == "mass_fractions":
        return random.dirichlet(np.ones(len(simulation.scene.phase)), simulation.particles)
    container = simulation.scene.container
    extent = container.extent()
    if extent is None:
        raise InputError('optimise.start.initial_positions is "random", but the scene has no container to fill.')
    half = 0.5 * simulation.scene.discretisation.spacing
    lower, upper = extent[0] + half, extent[1] - half
    x = random.uniform(lower, upper, simulation.positions.shape)
    while (outside := ~container.contains(x, 0.0)).any():  # in the corners around a cylinder
        x[outside] = random.uniform(lower, upper, x[outside].shape)
    return x


def _coordinates(task: Task, start: Arrays) -> dict[str, Bijector]:
    found: dict[str, Bijector] = {name: Logarithm() for name in task.optimise.logarithmic}
    for name, value in start.items():
        if name == "mass_fractions":
            found[name] = Softmax()
        elif task.known.has_rows(name, value) and task.optimise.knots is not None:
            found[name] = TimeInterpolation(task.problem.steps, task.optimise.knots)
    return found


def _bounds(task: Task) -> dict[str, tuple[Any, Any]]:
    """Bounds of coordinates, by name.

    Those of a parameter over time hold for its knots, and so for what is interpolated between them; those of a
    logarithmic parameter are logarithms. A parameter that cannot be negative has 0 as a lower bound.
    """
    with_zero = [name for name in task.start if task.known[name].range is Range.NOT_NEGATIVE]
    free = [name for name in with_zero if name not in task.optimise.logarithmic]
    found: dict[str, tuple[Any, Any]] = dict.fromkeys(free, (0.0, None))
    for name, pair in (task.optimise.bounds or {}).items():
        lower, upper = (np.log(b) if name in task.optimise.logarithmic else b for b in pair)
        found[name] = (lower, upper)
    return found
