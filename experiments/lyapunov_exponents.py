"""Lyapunov exponents of a flow and of its variants, by two methods that share nothing but the forward step.

The first method propagates tangents along a run, and makes them orthonormal at regular steps. The second measures how
fast two runs diverge whose first states are nearly the same; it uses no derivative, so that growth on which both agree
is a property of the flow. With a term of the derivative left out, the tangents show what that term contributes.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from cortado.reference import Simulation, Terms
from cortado.scene import tables
from cortado.scene.scene import Scene
from cortado.scene.tables import Several, Text, components, count, quantity
from experiments.ensembles import perturbed, side_by_side
from experiments.estimates import growth_rate, norms
from experiments.experiment import Progress, SceneSettings
from experiments.lyapunov_spectrum import growth_by_segment
from experiments.scenes import varied
from experiments.tables import Table

Term = Literal["viscosity", "pressure", "hessian", "density"]


class Variant(tables.Table):
    """A variant of the scene or of the derivative, which differs in one setting."""

    panel: Text
    """The panel of the picture in which it is drawn."""
    label: Text
    """Label of a curve in the panel, or of a bar where there is no ``x``."""
    x: Annotated[float, quantity()] | None = None
    """Its place on the curve."""
    scene: Mapping[str, Any] = Field(default_factory=dict)
    """Replacements in the scene."""
    without: Several[Term] = ()
    """Terms of the tangent that are left out (`cortado.reference.Terms`)."""


class LyapunovSettings(SceneSettings):
    """Exponents of the scene and of its variants."""

    fall: Annotated[float, quantity("m", gt=0.0)]
    """Height of the fall. Times are in units of its duration, (2 fall / g)^(1/2), so that variants with another gravity
    are compared at the same stage."""
    window: Annotated[tuple[Annotated[float, quantity("falls", ge=0.0)], ...], components("first", "last")]
    """Begin and end of the window in which exponents are measured."""
    seeds: Annotated[int, count(1, 100)]
    perturbation: Annotated[float, quantity("spacings", ge=0.0)]
    """Perturbation of the first positions [spacings]."""
    vectors: Annotated[int, count(1, 1000)]
    """Number of tangents for a variant."""
    spectrum: Annotated[int, count(1, 10_000)]
    """Number of tangents for the scene itself, with one seed."""
    segment: Annotated[int, count(1, 1000)]
    """Steps between two orthonormalisations."""
    velocity_time: Annotated[float, quantity("s", gt=0.0)]
    """Factor of velocities in the norm of a tangent."""
    separation: Annotated[float, quantity("m", gt=0.0)]
    """Distance of two runs at the start, in each coordinate."""
    linear: Annotated[float, quantity("m", gt=0.0)]
    """Distance of two runs, over all particles, up to which their divergence is measured."""
    variants: Several[Variant]


def window_steps(settings: LyapunovSettings, scene: Scene) -> tuple[int, int]:
    """The window in steps, whole segments."""
    gravity = float(np.linalg.norm(scene.forces.gravity))
    falls = np.sqrt(2.0 * settings.fall / gravity) / scene.solver.time_step
    first, last = (round(edge * falls / settings.segment) * settings.segment for edge in settings.window)
    return first, max(last, first + 2 * settings.segment)


def measure(settings: LyapunovSettings, progress: Progress) -> Table:
    """Columns: panel, label, x, seed, way ("tangent" or "pair"), index of the exponent, window ("all", "first half",
    "second half"), rate [1 / step] and rate_in_time [1 / s]."""
    cases: dict[str, tuple[Scene, tuple[str, ...]]] = {}
    keys = []
    for variant in settings.variants:
        scene = varied(settings.scene, **variant.scene) if variant.scene else settings.scene
        keys.append(scene.computed_json() + " ".join(variant.without))
        cases[keys[-1]] = scene, variant.without
    tasks = [
        partial(_exponents, settings, scene, without, settings.vectors, seed)
        for scene, without in cases.values()
        for seed in range(settings.seeds)
    ]
    tasks.append(partial(_exponents, settings, settings.scene, (), settings.spectrum, 0))
    with progress(len(tasks)) as advance:
        *found, spectrum = side_by_side(tasks, advance)
    by_case = {key: found[k * settings.seeds : (k + 1) * settings.seeds] for k, key in enumerate(cases)}
    named = [
        (variant.panel, variant.label, np.nan if variant.x is None else variant.x, seed, rows)
        for variant, key in zip(settings.variants, keys, strict=True)
        for seed, rows in enumerate(by_case[key])
    ]
    named.append(("spectrum", "base", np.nan, 0, spectrum))
    return Table.joined(
        {"panel": panel, "label": label, "x": x, "seed": seed, **row}
        for panel, label, x, seed, rows in named
        for row in rows
    )


def _exponents(
    settings: LyapunovSettings, scene: Scene, without: tuple[str, ...], vectors: int, seed: int
) -> list[dict[str, Any]]:
    simulation = Simulation(scene, threads=1)
    start = perturbed(simulation, seed, settings.perturbation)
    first, last = window_steps(settings, scene)
    middle = (first + last) // (2 * settings.segment) * settings.segment
    terms = Terms(**dict.fromkeys(without, False))
    logarithms = _growth(settings, simulation, start, terms, vectors, last, seed)
    rows = []

    def keep(way: str, index: int, window: str, rate: float) -> None:
        row = {"way": way, "index": index, "window": window, "rate": rate}
        rows.append({**row, "rate_in_time": rate / scene.solver.time_step})

    for window, begin, end in (("all", first, last), ("first half", first, middle), ("second half", middle, last)):
        sums = logarithms[begin // settings.segment : end // settings.segment].sum(axis=0)
        for index, rate in enumerate(sums / (end - begin)):
            keep("tangent", index, window, float(rate))
    if not without:
        keep("pair", 0, "all", _parting(settings, simulation, start, first, last, seed))
    return rows


def _growth(
    settings: LyapunovSettings,
    simulation: Simulation,
    start: np.ndarray,
    terms: Terms,
    vectors: int,
    steps: int,
    seed: int,
) -> np.ndarray:
    """Logarithms (segments, vectors) of the growth of tangents from the start on."""
    shape, time, segment = start.shape, settings.velocity_time, settings.segment

    def push(state: Mapping[str, Any], frame: np.ndarray) -> tuple[Mapping[str, Any], np.ndarray]:
        pushed = []
        for x_dot, v_dot in frame.reshape(-1, 2, *shape):
            along = {"initial_positions": x_dot, "initial_velocities": v_dot / time}
            after = simulation.tangent(state, along, segment, terms=terms, record_every=segment)
            assert after.position_tangents is not None and after.velocity_tangents is not None
            ends = after.position_tangents.high[1], time * after.velocity_tangents.high[1]
            pushed.append(np.concatenate([end.ravel() for end in ends]))
        last = {"initial_positions": after.positions.high[1], "initial_velocities": after.velocities.high[1]}
        return last, np.array(pushed)

    state = {"initial_positions": start, "initial_velocities": simulation.velocities}
    first = np.random.default_rng((seed, 1)).normal(size=(vectors, 2 * start.size))
    return growth_by_segment(push, state, first, steps // segment)


def _parting(
    settings: LyapunovSettings, simulation: Simulation, start: np.ndarray, first: int, last: int, seed: int
) -> float:
    """The rate at which two runs diverge, as long as they are close; nan where too few steps are."""
    offset = settings.separation * np.random.default_rng((seed, 2)).normal(size=start.shape)
    one, other = (simulation.run(last, {"initial_positions": at}) for at in (start, start + offset))
    apart = norms(other.positions - one.positions)
    steps = np.arange(first, last + 1)
    steps = steps[np.maximum.accumulate(apart)[steps] <= settings.linear]
    if len(steps) < 2 * settings.segment or apart[steps].min() <= 0.0:
        return float("nan")
    return growth_rate(steps, apart[steps])
