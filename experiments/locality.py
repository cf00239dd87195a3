"""Where the growth lives: at the scale of particles or of the fluid.

The derivative with respect to gravity, and one along a random direction, are decomposed into the common motion of all
particles, cosine modes of the box, the part that remains after an SPH average, and the change of a picture. They are
compared with white noise on the same particles, and with the effect of a change of gravity that is not small. The
growth of every part over time shows whether there is one that does not grow.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

from cortado.discretise.smoothing import smoothing_kernel
from cortado.pictures.plots import DASHED, FAINT, INK, PALETTE
from cortado.reference import History, Simulation
from cortado.scene.tables import Vector, count, quantity
from experiments import spatial_scales
from experiments.canvas import blank
from experiments.ensembles import perturbed, side_by_side
from experiments.estimates import Estimate, geometric_mean, growth_rate
from experiments.experiment import ExperimentType, Progress, SceneSettings, Window
from experiments.tables import Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

GRAVITY, RANDOM, CHANGE, NOISE = "derivative by gravity", "derivative, random", "change of gravity", "white noise"
SIZES = {"size": "all particles", "modes size": "longest waves", "common size": "centre of mass", "picture": "picture"}


class LocalitySettings(SceneSettings):
    """Settings of the decomposition of tangents by scale."""

    direction: Vector[Annotated[float, quantity("m/s2")]]
    """Direction of the change of gravity."""
    change: Annotated[float, quantity("m/s2", gt=0.0)]
    """The change of gravity that is not small, in both directions."""
    steps: Annotated[int, count(2, 10_000)]
    record_every: Annotated[int, count(1, 1000)]
    window: Window
    """Begin and end of the window in which rates are fitted and fractions averaged."""
    long_modes: Annotated[int, count(1, 10_000)]
    """Number of cosine modes that count as long waves."""
    seeds: Annotated[int, count(1, 100)]
    perturbation: Annotated[float, quantity("spacings", ge=0.0)]
    """Perturbation of the first positions [spacings]."""


def measure(settings: LocalitySettings, progress: Progress) -> Table:
    """Columns: seed, step, vector, quantity, value. Quantities are norms of a vector and of its parts, the fractions of
    its energy that parts have, and "modes k", that of the k longest waves."""
    tasks = [partial(_rows, settings, seed) for seed in range(settings.seeds)]
    with progress(settings.seeds) as advance:
        return Table.joined(side_by_side(tasks, advance))


def _rows(settings: LocalitySettings, seed: int) -> Table:
    simulation = Simulation(settings.scene, threads=1)
    start = {"initial_positions": perturbed(simulation, seed, settings.perturbation)}
    gravity = {"gravity": np.asarray(settings.direction)}
    random = np.random.default_rng((seed, 1))
    tangent = partial(simulation.tangent, start, steps=settings.steps, record_every=settings.record_every)
    histories = {
        GRAVITY: tangent(directions=gravity),
        RANDOM: tangent(directions={"initial_positions": random.normal(size=simulation.positions.shape)}),
        CHANGE: tangent(directions=gravity, method="finite_difference", difference=settings.change),
    }
    box: Any = settings.scene.container
    found = []
    for frame, step in enumerate(histories[GRAVITY].steps[1:].tolist(), start=1):
        positions = histories[GRAVITY].positions.high[frame]
        modes = spatial_scales.box_modes(positions, box.lower, box.upper)
        vectors = {name: _tangents(history)[frame] for name, history in histories.items()}
        vectors[NOISE] = random.normal(size=positions.shape)
        for vector, u in vectors.items():
            parts = _parts(settings, positions, modes, u)
            found += [(seed, step, vector, quantity, value) for quantity, value in parts.items()]
    return Table(dict(zip(("seed", "step", "vector", "quantity", "value"), zip(*found, strict=True), strict=True)))


def _tangents(history: History) -> np.ndarray:
    assert history.position_tangents is not None
    return history.position_tangents.high


def _parts(settings: LocalitySettings, positions: np.ndarray, box_modes: np.ndarray, u: np.ndarray) -> dict[str, float]:
    scene = settings.scene
    kernel, support = smoothing_kernel(scene.discretisation.kernel), scene.discretisation.support_radius
    shares = spatial_scales.shares_of_modes(box_modes, u)
    size = float(np.linalg.norm(u))
    common, modes = spatial_scales.common_share(u), float(shares[settings.long_modes - 1])
    picture = spatial_scales.picture_change(positions, u, scene.discretisation.spacing)
    return {
        "size": size,
        "common": common,
        "common size": size * common**0.5,
        "long modes": modes,
        "modes size": size * modes**0.5,
        "smoothed": spatial_scales.smoothed_share(positions, u, kernel, support),
        "participation": spatial_scales.participation(u),
        "picture": float(np.linalg.norm(picture)),
        **{f"modes {k}": float(shares[k - 1]) for k in _counts(len(u))},
    }


def _counts(particles: int) -> list[int]:
    """Numbers of modes, about evenly spaced on a logarithmic scale."""
    return sorted({round(k) for k in np.geomspace(1, particles, 16)})


def draw(table: Table, settings: LocalitySettings) -> Figure:
    """Energy of long waves; growth of every part; and the number of particles that take part."""
    figure = blank(15.0, 5.4)
    spectrum, growth, spread = figure.subplots(1, 3)
    figure.suptitle(settings.title)
    inside = _inside(table, settings)
    counts = _mode_counts(table)
    colours = dict(zip((GRAVITY, RANDOM, CHANGE), PALETTE, strict=False))
    for vector in table.values("vector"):
        rows = inside.where(vector=vector)
        shares = [rows.where(quantity=f"modes {k}")["value"].mean() for k in counts]
        style: dict[str, Any] = {"color": INK, **DASHED} if vector == NOISE else {"color": colours[vector]}
        spectrum.loglog(counts, shares, label=vector, **style)
        count = [_mean(rows) for rows in _by_step(table, vector, "participation")]
        spread.plot(table.values("step"), count, label=vector, **style)
    spectrum.set(title="Energy in the longest waves", xlabel="cosine modes of the box", ylabel="share")
    spectrum.legend(fontsize=9)
    for k, (size, name) in enumerate(SIZES.items()):
        for vector, style in ((GRAVITY, {}), (CHANGE, DASHED)):
            sizes = [_mean(rows, logarithmic=True) for rows in _by_step(table, vector, size)]
            label = name if vector == GRAVITY else None
            growth.semilogy(table.values("step"), sizes, color=PALETTE[k], label=label, **style)
    growth.plot([], [], color=FAINT, label=f"change of {settings.change:g} m/s²", **DASHED)
    growth.set(title="Growth of every part", xlabel="step", ylabel="part of |dx / dg| [s²], of |dI / dg| [s²/m]")
    growth.legend(fontsize=9)
    spread.set(title="Particles that take part", xlabel="step", ylabel="participation number", ylim=(0.0, None))
    return figure


def verdict(table: Table, settings: LocalitySettings) -> list[str]:
    """The energy of each part relative to that of noise, the growth rates, and the fluid's response to a finite
    change."""
    inside = _inside(table, settings)

    def estimate(vector: str, quantity: str) -> Estimate:
        rows = inside.where(vector=vector, quantity=quantity)
        return Estimate.of([one["value"].mean() for _, one in rows.groups("seed")])

    def against_noise(quantity: str) -> str:
        return f"{estimate(GRAVITY, quantity).over(estimate(NOISE, quantity))}"

    rates = {quantity: _rate(inside, GRAVITY, quantity) for quantity in SIZES}
    still = {quantity: _rate(inside, CHANGE, quantity) for quantity in SIZES}
    end = table.where(step=max(table.values("step")), quantity="common size")
    excess = np.exp(np.mean(np.log(end.where(vector=GRAVITY)["value"] / end.where(vector=CHANGE)["value"])))
    particles = max(_mode_counts(table))
    finer = all(
        estimate(GRAVITY, quantity).value < estimate(NOISE, quantity).value
        for quantity in ("common", "long modes", "smoothed")
    )
    return [
        f"Of the derivative's energy the common motion has {against_noise('common')} times what it has in white noise, "
        f"the {settings.long_modes} longest waves {against_noise('long modes')} times, and what an SPH average leaves "
        f"{against_noise('smoothed')} times.",
        f"It is spread over {estimate(GRAVITY, 'participation')} of {particles} particles, one "
        f"along a random direction over {estimate(RANDOM, 'participation')}, the response to a change of gravity by "
        f"{settings.change:g} m/s² over {estimate(CHANGE, 'participation')}.",
        "Rates of growth a step: " + ", ".join(f"{name} {rates[part]}" for part, name in SIZES.items()) + ".",
        f"The response to that change of gravity does not grow ({still['size']} a step; centre of mass "
        f"{still['common size']}); at step {max(table.values('step'))} the derivative of the centre of mass is "
        f"{excess:.0e} times it.",
        f"Where it lives: {'at the scale of particles' if finer else 'not only at the scale of particles'}; but no "
        f"part of the exact derivative is free of it: the centre of mass grows "
        f"{rates['common size'].over(rates['size'])} times as fast as the whole.",
    ]


def _mode_counts(table: Table) -> list[int]:
    names = [name.removeprefix("modes ") for name in table.values("quantity") if name.startswith("modes ")]
    return [int(name) for name in names if name.isdecimal()]


def _inside(table: Table, settings: LocalitySettings) -> Table:
    first, last = settings.window
    return table.chosen((table["step"] >= first) & (table["step"] <= last))


def _by_step(table: Table, vector: str, quantity: str) -> Iterator[Table]:
    for _, rows in table.where(vector=vector, quantity=quantity).groups("step"):
        yield rows


def _mean(rows: Table, logarithmic: bool = False) -> float:
    return geometric_mean(rows["value"]) if logarithmic else float(rows["value"].mean())


def _rate(inside: Table, vector: str, quantity: str) -> Estimate:
    rows = inside.where(vector=vector, quantity=quantity)
    return Estimate.of([growth_rate(one["step"], one["value"]) for _, one in rows.groups("seed")])


LOCALITY = ExperimentType("locality", LocalitySettings, measure, draw, verdict)
