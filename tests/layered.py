"""What the tests of layers in PyTorch and in JAX share: a fluid that is sheared, its problems, and bad uses."""

from collections.abc import Callable
from typing import Any

import numpy as np

from bad_scenes import one_sentence
from cortado import Problem, Scene, Simulation, losses
from scenes import plane

STIFF = 20.0
"""Pa s: what a viscosity is given in units of, so that all derivatives are of a size."""


def sheared(**changes: Any) -> Scene:
    """8 x 8 particles of a viscous fluid that is pushed along the floor of a box, under a gravity with a schedule."""
    thick = [{"name": "water", "rest_density": 1000.0, "viscosity": STIFF}]
    return plane(phase=thick, **changes)


def scheduled() -> Scene:
    """Under a gravity that changes."""
    course = {"times": [0.0, 0.03, 0.06, 0.2], "values": [[0.0, -9.81], [4.0, -9.81], [-3.0, -7.0], [0.0, -9.81]]}
    return sheared(schedule={"gravity": course})


def shear(simulation: Simulation) -> np.ndarray:
    """(n, d) first velocities [m / s] that a viscosity slows."""
    found = np.zeros(simulation.positions.shape)
    found[:, 0] = 2.0 * simulation.positions[:, 1]
    return found


def matched(simulation: Simulation) -> Problem:
    """A problem that looks at all positions."""
    return Problem(simulation, 12, losses.FinalPositions(simulation.positions + 0.02))


POINT = {"gravity": [0.4, -9.0], "viscosity": 0.7 * STIFF}


def same_bits(one: dict[str, Any], other: dict[str, Any]) -> None:
    """Whether arrays by name are the same."""
    assert one.keys() == other.keys()
    for name in one:
        assert np.asarray(one[name]).tobytes() == np.asarray(other[name]).tobytes(), name


def without(table: dict[str, Any], name: str) -> dict[str, Any]:
    """All but one of its entries."""
    return {key: value for key, value in table.items() if key != name}


ARRAY = r"(an array|a tensor) of (torch\.)?"
BAD_STATES: dict[str, tuple[Callable[[dict[str, Any]], Any], str]] = {
    "no table": (lambda s: 3.0, "state is 3.0, but must be a dictionary"),
    "left out": (lambda s: None, "state is left out, but must have positions"),
    "without a field": (lambda s: without(s, "velocities"), "state has .*, but must have positions, velocities"),
    "without its time": (lambda s: without(s, "time"), "state has .*, but must have .* time"),
    "another field": (lambda s: {**s, "colour": s["time"]}, "state has .*colour.*, but must have positions"),
    "another shape": (lambda s: {**s, "positions": s["positions"][1:]}, r"state positions has shape \(63, 2\), but"),
    "truth values": (lambda s: {**s, "positions": s["positions"] > 0}, f"state positions is {ARRAY}bool"),
    "text": (lambda s: {**s, "positions": "here"}, "state positions is 'here', but must be a number or an array"),
    "NaN": (lambda s: {**s, "positions": s["positions"] * np.nan}, "state positions has a value that is not finite"),
    "infinite": (lambda s: {**s, "velocities": s["velocities"] + np.inf}, "state velocities has a value that is not"),
    "huge": (lambda s: {**s, "velocities": s["velocities"] + 1e60}, "state velocities has a value of size 1e"),
    "a negative time": (lambda s: {**s, "time": s["time"] - 1.0}, "state clock is at -1.0 s, but must be"),
    "another fluid": (lambda s: {**s, "reference_density": 2.0 * s["reference_density"]}, "state reference_density is"),
    "outside": (lambda s: {**s, "positions": s["positions"] + 5.0}, "outside the container"),
    "another spacing": (lambda s: {**s, "positions": 0.5 * s["positions"]}, "spacings of 0.05 m between neighbours"),
}
"""What is done to a state, and words of the sentence that it is refused with."""
BAD_PARAMETERS: dict[str, tuple[Callable[[], Any], str]] = {
    "no table": (lambda: [1.0], r"parameters is \[1.0\], but must be a dictionary"),
    "unknown": (lambda: {"gravty": np.zeros(2)}, "parameter 'gravty' is unknown, but must be one of"),
    "of another scene": (lambda: {"surface_tension": 1.0}, "parameter surface_tension is given, but must be left out"),
    "another shape": (lambda: {"gravity": np.zeros(3)}, r"parameter gravity has shape \(3,\), but must be \(2,\)"),
    "another number of steps": (lambda: {"gravity": np.zeros((4, 2))}, r"parameter gravity has shape \(4, 2\), but"),
    "first values": (lambda: {"initial_velocities": np.zeros((64, 2))}, "must be left out"),
    "negative": (lambda: {"viscosity": -1.0}, "parameter viscosity is -1.0, but must be at least 0"),
    "NaN": (lambda: {"viscosity": np.nan}, "parameter viscosity has a value that is not finite"),
    "text": (lambda: {"viscosity": "thick"}, "parameter viscosity is 'thick', but must be a number"),
    "both": (lambda: {"tilt": [3.0], "gravity": [0.0, 1.0]}, "gravity is given, but must be left out, as tilt is"),
}


def assert_refused(words: str, *uses: Callable[[], Any]) -> None:
    """Each ends in one sentence with these words."""
    for use in uses:
        with one_sentence(words):
            use()


def uses_of_state(layer: Any, simulation: Simulation, problem: Problem, state: Any) -> list[Callable[[], Any]]:
    """Whatever takes a state; a value begins where the scene does if there is none."""
    value = layer.value(problem)
    return [
        lambda: layer.step(simulation, state, steps=2),
        lambda: layer.rollout(simulation, state, steps=2),
        lambda: layer.measure(simulation, "density")(state),
        *([] if state is None else [lambda: value({}, state)]),
    ]


def uses_of_parameters(
    layer: Any, simulation: Simulation, problem: Problem, make: Callable[[], Any]
) -> list[Callable[[], Any]]:
    """Whatever takes parameters; a value may have first ones, where it has no state."""
    state, value = layer.state(simulation), layer.value(problem)
    first = isinstance(make(), dict) and "initial_velocities" in make()
    uses = [lambda: layer.step(simulation, state, make(), steps=2), lambda: value(make(), state)]
    return uses if first else [*uses, lambda: value(make())]
