"""Estimators against the gradient of a smoothed loss: ``python validation/gradients.py --out runs/gradients`` (1 h).

Five flows of 144 to 176 particles in the plane, with a spacing of 0.025 m, time step 1 ms, 4 pressure iterations a
step, in float64: see `SCENES`. The parameter is gravity, constant or in equal blocks of time (``--blocks``). A seed
moves the first positions by 1 % of the spacing, and draws the gravity of a run whose last state is the target of the
losses: centre of mass, Gaussian density on a grid, picture with two distances, and positions particle by particle.

The reference is `gradients.RandomizedSmoothing` with a spread of 0.5 m/s2. For each estimator the script writes the
cosine of its gradient to the reference, and its size over the reference's, into `gradients_4.csv` (for 4 blocks) with a
picture, and prints the medians over seeds. ``--coefficients`` compares such of `gradients.AdjointViscosity` instead,
also with another ``--kernel`` and ``--support``.
"""

import argparse
import csv
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from cortado import Problem, Scene, Simulation, gradients, losses
from cortado.files.terminal import track
from cortado.image_losses import Pyramid
from cortado.pictures.plots import INK, PALETTE, drawing
from cortado.render.renderer import scene_renderer

SPACING, GRAVITY = 0.025, (0.0, -9.81)
MOST_BLOCKS = 8
POSITION_NOISE = 0.01
"""Of the first positions [spacings], of a seed and again of the reference's ensemble."""
SPREAD = 0.5
"""Of the reference's gravities [m/s2]."""
TILT, TRUE_SPREAD = 3.0, 1.0
"""How far the target's gravities lean to a side, and their standard deviation [m/s2]."""
LOSSES = ("centre of mass", "density grid", "picture, pyramid", "picture", "particles")
ESTIMATORS: dict[str, gradients.GradientEstimator] = {
    "exact": gradients.Exact(),
    "viscosity": gradients.AdjointViscosity(),
    "mean over 8": gradients.EnsembleMean(SPREAD, 8, POSITION_NOISE, seed=77),
}
WATER = {"name": "water", "rest_density": 1000.0, "viscosity": 0.05, "colour": [0.1, 0.3, 0.8]}
OIL = {"name": "oil", "rest_density": 1600.0, "viscosity": 0.4, "colour": [0.8, 0.6, 0.1]}


@dataclass(frozen=True)
class Flow:
    """A scene in a box of 0.6 m x 0.9 m."""

    blocks: tuple[dict[str, Any], ...]
    kernel: str = "cubic_spline"
    support: float = 2.0
    phases: tuple[dict[str, Any], ...] = (WATER,)
    nozzle: dict[str, Any] | None = None

    def scene(self) -> Scene:
        """As a scene."""
        return Scene(
            dimension=2,
            discretisation={"spacing": SPACING, "support": self.support, "kernel": self.kernel},
            phase=self.phases,
            fluid=self.blocks,
            container={"shape": "box", "lower": [0.0, 0.0], "upper": [0.6, 0.9]},
            forces={"gravity": [0.0, -9.81], "viscosity": "pairwise"},
            solver={"kind": "pcisph", "time_step": 0.001, "minimum_iterations": 4, "maximum_iterations": 4},
            render={"view": "plane", "resolution": [24, 36]},
            **({} if self.nozzle is None else {"emitter": [self.nozzle]}),
        )


def block(lower: tuple[float, float], upper: tuple[float, float], phase: str = "water", speed: float = 0.0) -> Any:
    """A box full of fluid that moves to the right."""
    return {"shape": "box", "lower": lower, "upper": upper, "phase": phase, "velocity": (speed, 0.0)}


NOZZLE = {"phase": "water", "outlet": [0.2, 0.35], "radius": 0.05, "length": 0.5, "flow_rate": 0.1}
SCENES = {
    "dam break": Flow((block((0.0, 0.0), (0.3, 0.3)),)),
    "drop": Flow((block((0.0, 0.0), (0.6, 0.1)), block((0.1, 0.3), (0.25, 0.5)))),
    "crash": Flow(
        (block((0.0, 0.0), (0.2, 0.225), speed=1.0), block((0.4, 0.0), (0.6, 0.225), speed=-1.0)), "wendland_c2", 2.5
    ),
    "two fluids": Flow(
        (block((0.0, 0.0), (0.2, 0.3)), block((0.2, 0.0), (0.4, 0.2), "oil")), "wendland_c4", 3.0, (WATER, OIL)
    ),
    "jet": Flow((block((0.0, 0.0), (0.6, 0.1)),), nozzle=NOZZLE),
}
"""A column of water that collapses, a drop that falls into a pool, two columns that run into each other, oil beside a
higher column of water, and a jet into a pool; each with a kernel of its own."""


class DensityGrid:
    """Squared distance of two Gaussian densities on a grid of two spacings, each particle spread over two spacings."""

    width, nodes = 2.0 * SPACING, np.linspace(0.0, 0.9, 19)

    def __init__(self, target: np.ndarray):
        self.target = self.density(target)

    def axes(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(n, nodes) of both axes."""
        a, b = (np.exp(-0.5 * ((x[:, k, None] - self.nodes) / self.width) ** 2) for k in range(2))
        return a, b

    def density(self, x: np.ndarray) -> np.ndarray:
        """(nodes, nodes)"""
        a, b = self.axes(x)
        return a.T @ b / len(x)

    def value(self, end: losses.Snapshot) -> float:
        return float(((self.density(end.positions) - self.target) ** 2).sum())

    def adjoint(self, end: losses.Snapshot) -> tuple[np.ndarray, np.ndarray]:
        x = end.positions
        (a, b), bar = self.axes(x), 2.0 * (self.density(x) - self.target) / len(x)
        slopes = [-(x[:, k, None] - self.nodes) / self.width**2 * w for k, w in enumerate((a, b))]
        x_bar = np.stack([((slopes[0] @ bar) * b).sum(1), ((a @ bar) * slopes[1]).sum(1)], axis=1)
        return x_bar, np.zeros_like(x)


class Case:
    """One seed and horizon: the losses, and all of them after any run."""

    def __init__(self, flow: Flow, seed: int, steps: int, blocks: int):
        simulation = Simulation(flow.scene(), precision="float64")
        random = np.random.default_rng(seed)
        self.simulation, self.steps, self.blocks = simulation, steps, blocks
        self.gravity = np.tile(GRAVITY, (blocks, 1))
        self.start = simulation.positions + POSITION_NOISE * SPACING * random.standard_normal(
            simulation.positions.shape
        )
        true_gravity = self.gravity + [random.choice([-TILT, TILT]), 0.0]
        true_gravity += TRUE_SPREAD * random.standard_normal(true_gravity.shape)
        self.problem = Problem(simulation, steps, losses.CentreOfMass([0.0, 0.0]))
        target = self.problem.end(self.parameters({"gravity": true_gravity}))
        renderer = scene_renderer(simulation)
        picture = renderer.render(target.state.positions, target.state.mass_fractions, target.colours)
        made: list[Any] = [
            losses.CentreOfMass(target.positions.mean(axis=0)),
            DensityGrid(target.positions),
            losses.Image(renderer, picture, Pyramid()),
            losses.Image(renderer, picture),
            losses.FinalPositions(target.positions),
        ]
        self.losses = dict(zip(LOSSES, made, strict=True))
        self._seen: dict[bytes, dict[str, float]] = {}

    def parameters(self, values: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Of the problem, for gravity in blocks."""
        blocks = np.repeat(values["gravity"], self.steps // self.blocks, axis=0)
        return {"initial_positions": values.get("initial_positions", self.start), "gravity": blocks}

    def values(self, values: dict[str, np.ndarray]) -> dict[str, float]:
        """All losses of one run."""
        parameters = self.parameters(values)
        key = parameters["gravity"].tobytes() + parameters["initial_positions"].tobytes()
        if key not in self._seen:
            end = self.problem.end(parameters)
            self._seen[key] = {name: loss.value(end) for name, loss in self.losses.items()}
        return self._seen[key]

    def estimate(self, loss: str, estimator: gradients.GradientEstimator) -> gradients.Estimate:
        """The gradient of a loss with respect to gravity in blocks."""
        return estimator.estimate(One(self, loss), {"gravity": self.gravity})


class One:
    """One loss of a case with gravity in blocks, as estimators see a problem."""

    def __init__(self, case: Case, name: str):
        self._case, self._name = case, name
        self._problem = Problem(case.simulation, case.steps, case.losses[name])
        simulation = case.simulation
        self.simulation = SimpleNamespace(
            positions=case.start,
            scene=simulation.scene,
            batch=None,
            precision=simulation.precision,
            known=simulation.known,
        )

    def value(self, values: dict[str, np.ndarray]) -> float:
        return self._case.values(values)[self._name]

    def forward_pass(self, values: dict[str, np.ndarray]) -> "InBlocks":
        return InBlocks(self._problem.forward_pass(self._case.parameters(values)), self._case.blocks)


class InBlocks:
    """The ways back through a run, with the gradient in blocks."""

    def __init__(self, forward_pass: Any, blocks: int):
        self._passage, self._blocks, self.loss = forward_pass, blocks, forward_pass.loss

    def back(self, estimator: Any, observe: Any = None) -> dict[str, np.ndarray]:
        gradient = self._passage.back(estimator, observe)["gravity"]
        return {"gravity": gradient.reshape(self._blocks, -1, 2).sum(axis=1)}


Row = dict[str, Any]
FIELDS = (
    "scene",
    "seed",
    "steps",
    "loss",
    "estimator",
    "cosine",
    "size",
    *(f"g{k}" for k in range(2 * MOST_BLOCKS)),
)


@dataclass(frozen=True)
class Work:
    """One seed and horizon of a scene."""

    scene: str
    flow: Flow
    seed: int
    steps: int
    blocks: int

    @property
    def key(self) -> tuple[str, int, int]:
        """As rows begin."""
        return self.scene, self.seed, self.steps

    def case(self) -> Case:
        """Made in the process that works on it."""
        return Case(self.flow, self.seed, self.steps, self.blocks)

    def row(self, loss: str, estimator: str, gradient: np.ndarray) -> Row:
        """One line of the file."""
        numbers = {f"g{k}": float(value) for k, value in enumerate(gradient.ravel())}
        named = {"scene": self.scene, "seed": self.seed, "steps": self.steps}
        return {**named, "loss": loss, "estimator": estimator, **numbers}


def references(work: Work, samples: int) -> list[Row]:
    """Two references of half the samples each, for every loss, from the same runs."""
    case, rows = work.case(), []
    for half in (1, 2):
        reference = gradients.RandomizedSmoothing(SPREAD, samples // 2, POSITION_NOISE, 1000 * work.seed + half)
        for loss in LOSSES:
            gradient = case.estimate(loss, reference).gradient["gravity"]
            rows.append(work.row(loss, f"reference {half} of {samples}", gradient))
    return rows


def estimator_rows(work: Work, loss: str, estimators: Mapping[str, gradients.GradientEstimator]) -> list[Row]:
    """The gradients of every estimator, for a loss."""
    case = work.case()
    return [work.row(loss, name, case.estimate(loss, one).gradient["gravity"]) for name, one in estimators.items()]


def case_of(line: Row) -> tuple[str, int, int]:
    """The scene, the seed and the number of steps."""
    return line["scene"], int(line["seed"]), int(line["steps"])


def gradient_of(line: Row) -> np.ndarray:
    """(2 blocks,)"""
    return np.array([float(line[f"g{k}"]) for k in range(2 * MOST_BLOCKS) if line.get(f"g{k}", "") != ""])


def cosine(a: np.ndarray, b: np.ndarray) -> float:
    """Of two gradients."""
    return float(a @ b / (np.linalg.norm(a) * np.linalg.norm(b)))


def compared(rows: list[Row], halves: list[Row]) -> list[Row]:
    """The rows with cosine and size to their references; the references' are those of one half to the other."""
    pairs: dict[Any, list[Row]] = {}
    for line in halves:
        pairs.setdefault((case_of(line), line["loss"]), []).append(line)
    found = []
    for line in rows:
        whole = np.mean([gradient_of(half) for half in pairs[case_of(line), line["loss"]]], axis=0)
        g = gradient_of(line)
        found.append(line | {"cosine": cosine(g, whole), "size": float(np.linalg.norm(g) / np.linalg.norm(whole))})
    for one, other in pairs.values():
        a, b = gradient_of(one), gradient_of(other)
        sizes = {"cosine": cosine(a, b), "size": float(np.linalg.norm(a) / np.linalg.norm(b))}
        found.append(one | {"estimator": "one half of the reference to the other", **sizes})
    return found


def read(path: Path) -> list[Row]:
    """Rows of a file, none if it is not there."""
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def write(path: Path, rows: Iterable[Row]) -> None:
    """All rows, as CSV."""
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, FIELDS, restval="")
        writer.writeheader()
        writer.writerows(rows)


def report(rows: list[Row]) -> None:
    """Print medians over seeds, and over all scenes: cosine [least], size."""
    names = list(dict.fromkeys(line["loss"] for line in rows))
    scenes = list(dict.fromkeys(line["scene"] for line in rows))
    for steps in sorted({int(line["steps"]) for line in rows}):
        print(f"\n{steps} steps: median cosine to the reference [least], median size over the reference's")
        for scene in [*scenes, None] if len(scenes) > 1 else scenes:
            chosen = [x for x in rows if int(x["steps"]) == steps and scene in (x["scene"], None)]
            print(f"{scene or 'all':40}" + "".join(f"{name:>28}" for name in names))
            for estimator in dict.fromkeys(line["estimator"] for line in rows):
                cells = []
                for name in names:
                    of = [x for x in chosen if (x["loss"], x["estimator"]) == (name, estimator)]
                    cosines, sizes = ([float(x[key]) for x in of] for key in ("cosine", "size"))
                    cells.append(f"{np.median(cosines):8.3f} [{min(cosines):6.3f}] {np.median(sizes):9.2g}")
                print(f"{estimator:40}" + "".join(f"{cell:>28}" for cell in cells))


def draw(rows: list[Row], path: Path) -> None:
    """Cosine and size of each estimator, a dot for each scene and seed, and a line at the median."""
    drawn = [name for name in dict.fromkeys(line["estimator"] for line in rows) if "half" not in name]
    horizons = sorted({int(line["steps"]) for line in rows})
    with drawing(path, 6.5 * len(horizons), 7.0) as figure:
        panels = figure.subplots(2, len(horizons), sharex=True, sharey="row", squeeze=False)
        for k, steps in enumerate(horizons):
            for key, panel in zip(("cosine", "size"), panels[:, k], strict=True):
                for number, estimator in enumerate(drawn):
                    for at, loss in enumerate(LOSSES):
                        chosen = (steps, loss, estimator)
                        of = [x for x in rows if (int(x["steps"]), x["loss"], x["estimator"]) == chosen]
                        values = np.array([float(x[key]) for x in of])
                        x = at + 0.15 * (number - (len(drawn) - 1) / 2)
                        label = estimator if at == 0 else None
                        panel.plot(np.full(len(values), x), values, ".", color=PALETTE[number], ms=5, alpha=0.7)
                        line = {"color": PALETTE[number], "lw": 2.5, "label": label}
                        panel.plot([x - 0.06, x + 0.06], [np.median(values)] * 2, **line)
            panels[0, k].set_title(f"after {steps} steps")
            panels[1, k].set_yscale("log")
            panels[1, k].axhline(1.0, color=INK, lw=0.8)
            panels[1, k].set_xticks(range(len(LOSSES)), LOSSES, rotation=20, ha="right")
        panels[0, 0].set_ylabel("cosine to the smoothed gradient")
        panels[1, 0].set_ylabel("size over the smoothed gradient's")
        figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=len(drawn))


def main(arguments: Sequence[str] | None = None) -> None:
    """See the head of the file."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("runs/estimators"))
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=["dam break", "crash", "two fluids", "jet"])
    parser.add_argument("--kernel", help="another kernel than the scenes have")
    parser.add_argument("--support", type=float, help="another support than the scenes have, in spacings")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--steps", type=int, nargs="+", default=[400, 800], help="multiples of the blocks")
    parser.add_argument("--blocks", type=int, default=4, help="of time in which gravity is a parameter, at most 8")
    parser.add_argument("--samples", type=int, default=8, help="of the reference, 4 runs a block; an even number")
    parser.add_argument("--coefficients", type=float, nargs="+", help="compare these of the viscosity instead")
    parser.add_argument("--processes", type=int, default=2)
    given = parser.parse_args(arguments)
    given.out.mkdir(parents=True, exist_ok=True)
    changes = {name: getattr(given, name) for name in ("kernel", "support") if getattr(given, name) is not None}
    kinds = "".join(f"_{value}" for value in changes.values())
    works = [
        Work(scene, replace(SCENES[scene], **changes), seed, steps, given.blocks)
        for steps in given.steps
        for scene in given.scenes
        for seed in given.seeds
    ]
    estimators = ESTIMATORS
    if given.coefficients:
        estimators = {f"coefficient {c:g}": gradients.AdjointViscosity(c) for c in given.coefficients}
    file = given.out / f"references_{given.blocks}_{given.samples}{kinds}.csv"
    kept = read(file)
    known = {case_of(line) for line in kept}
    rows: list[Row] = []
    with (
        ProcessPoolExecutor(given.processes, get_context("spawn")) as pool,
        track(sum(len(LOSSES) + (work.key not in known) for work in works), "cases") as advance,
    ):
        wanted = {pool.submit(references, work, given.samples): kept for work in works if work.key not in known}
        wanted |= {pool.submit(estimator_rows, work, loss, estimators): rows for work in works for loss in LOSSES}
        for done in as_completed(wanted):
            wanted[done].extend(done.result())
            write(file, kept)
            advance()
    keys = [work.key for work in works]
    halves = [line for line in kept if case_of(line) in keys]
    order = list(estimators)
    rows.sort(key=lambda x: (keys.index(case_of(x)), order.index(x["estimator"]), LOSSES.index(x["loss"])))
    found = compared(rows, halves)
    name = f"coefficients_{given.blocks}{kinds}" if given.coefficients else f"gradients_{given.blocks}{kinds}"
    write(given.out / f"{name}.csv", found)
    report(found)
    draw(found, given.out / f"{name}.png")
    print(f"\nwritten: {given.out / name}.csv")


if __name__ == "__main__":
    main()
