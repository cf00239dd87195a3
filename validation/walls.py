"""Do walls do work? A dam break's energy and water at rest with the viscosity of water, for three kernels.

``python validation/walls.py`` prints tables and the rows of `validation/README.md` that they give, which ``--write``
keeps (see `measured_rows.py`): about 20 minutes.
"""

import argparse
from collections.abc import Iterator
from typing import Any

import measured_rows as rows
import numpy as np

from cortado.discretise.smoothing import lattice_offsets, smoothing_kernel
from cortado.scene.scene import Scene
from cortado.simulation import Simulation

GRAVITY = 9.81
KERNELS = (("cubic_spline", 2.0), ("wendland_c2", 2.6), ("wendland_c4", 3.0))
ROWS = ("walls_work", "walls_rest")
"""Of `measured.csv`."""


def scene(kernel: str, support: float, spacing: float, viscosity: float, **tables: Any) -> Scene:
    """Water under gravity, by a kernel with a support in spacings; spacing [m], viscosity [Pa s]."""
    dimension = len(tables["fluid"]["upper"])
    return Scene(
        dimension=dimension,
        discretisation={"spacing": spacing, "support": support, "kernel": kernel},
        phase=[{"name": "water", "rest_density": 1000.0, "viscosity": viscosity}],
        fluid=[{"shape": "box", "phase": "water", **tables["fluid"]}],
        container=tables["container"],
        forces={"viscosity": "pairwise", "gravity": [0.0, -GRAVITY, 0.0][:dimension]},
        solver=tables["solver"],
    )


def dam_break(kernel: str, support: float, round_walls: bool, **solver: Any) -> Scene:
    """4,096 particles: a cube of 1 m in the corner of a tank, or in the middle of a cup; steps of 0.5 ms."""
    lower = [-0.5, 0.0, -0.5] if round_walls else [0.0, 0.0, 0.0]
    tank = {"shape": "box", "lower": lower, "upper": [2.0, 2.0, 1.0]}
    cup = {"shape": "cylinder", "base": [0.0, 0.0, 0.0], "radius": 1.0, "height": 2.0}
    return scene(
        kernel,
        support,
        1.0 / 16.0,
        0.0,
        fluid={"lower": lower, "upper": [x + 1.0 for x in lower]},
        container=cup if round_walls else tank,
        solver={"kind": "pcisph", "time_step": 0.0005, "maximum_iterations": 100, **solver},
    )


def energies(made: Scene, steps: int) -> np.ndarray:
    """(frames,) mean of v^2 / 2 + g y [J/kg], every fourth step."""
    trajectory = Simulation(made).run(steps, record_every=4)
    x, v = trajectory.positions.astype(np.float64), trajectory.velocities.astype(np.float64)
    return 0.5 * (v**2).sum(axis=2).mean(axis=1) + GRAVITY * x[..., 1].mean(axis=1)


def at_rest(kernel: str, support: float, dimension: int) -> tuple[float, float, float, float]:
    """Speed [m/s] from 2 to 2.5 s and on to 3 s, and the error of the pressure, averaged from 2 to 3 s, over rho g H,
    of all particles and of those within the support of a wall; all root mean squares. H is 1 m."""
    across, wide = (40, 0.8) if dimension == 2 else (16, 1.0)
    spacing = 1.0 / across
    time_step = (0.02 if dimension == 2 else 0.016) * spacing
    lower, upper = [0.0] * dimension, [wide, 1.0, wide][:dimension]
    simulation = Simulation(
        scene(
            kernel,
            support,
            spacing,
            0.001,
            fluid={"lower": lower, "upper": upper},
            container={"shape": "box", "lower": lower, "upper": [wide, 1.5, wide][:dimension]},
            solver={"kind": "pcisph", "time_step": time_step, "maximum_iterations": 100, "density_tolerance": 0.001},
        )
    )
    first, last = round(2.0 / time_step), round(3.0 / time_step)
    pressures, positions = np.zeros(simulation.particles), np.zeros((simulation.particles, dimension))
    squares: list[float] = []

    def observe(step: int, state: Any) -> None:
        if step > first:
            fields = state.numpy(dimension)
            x, v = fields["positions"], fields["velocities"]
            squares.append(float((v.astype(np.float64) ** 2).sum(axis=1).mean()))
            order = simulation.solver.search.order.numpy()[: simulation.particles]
            pressures[order] += simulation.solver.iterates.p[1].numpy() / (last - first)
            positions[:] += x / (last - first)

    simulation.rollout(last).forward(observe, keep=False)
    errors = pressures / (1000.0 * GRAVITY) - (1.0 - positions[:, 1])
    sides = positions[:, [axis for axis in range(dimension) if axis != 1]]
    near = np.minimum(np.minimum(sides, wide - sides).min(axis=1), positions[:, 1]) < support * spacing
    halves = np.sqrt([np.mean(half) for half in np.array_split(squares, 2)])
    return halves[0], halves[1], float(np.sqrt((errors**2).mean())), float(np.sqrt((errors[near] ** 2).mean()))


def column_slopes(kernel: str, support: float, dimension: int) -> np.ndarray:
    """(40,) dp/dz over rho g that layers of the rest lattice beside a vertical wall need, to carry their own weight.

    A frozen wall pushes along its normal alone, so that sum_k t_|k - l| s_k = 1 over the layers k of the fluid, where
    t_k is what a layer at k spacings adds to a vertical gradient.
    """
    offsets = lattice_offsets(1.0, support, dimension)
    shares = -offsets[:, 1] * smoothing_kernel(kernel).gradient(offsets, support)[:, 1]
    apart = np.abs(offsets[:, 0]).round().astype(int)
    t = np.array([shares[(apart == k) & (offsets[:, 0] >= 0.0)].sum() for k in range(40)])
    t /= shares.sum()
    return np.linalg.solve(t[np.abs(np.subtract.outer(np.arange(40), np.arange(40)))], np.ones(40))


def lines(printer: rows.Printer) -> Iterator[str]:
    """The tables, a line at a time."""
    greatest, speeds = [], {}
    yield "slopes of the pressure, over rho g, that the layers of the rest lattice beside a vertical wall need"
    for dimension in (2, 3):
        for kernel, support in KERNELS:
            slopes = " ".join(f"{slope:.2f}" for slope in column_slopes(kernel, support, dimension)[:4])
            yield f"{dimension}-D {kernel}: {slopes}"
    yield "dam break: greatest energy over the first, in 1.2 s"
    for kernel, support in KERNELS:
        for round_walls in (False, True):
            for solver in ({"density_tolerance": 0.0001}, {"minimum_iterations": 20, "maximum_iterations": 20}):
                energy = energies(dam_break(kernel, support, round_walls, **solver), 2400)
                greatest.append(float(energy.max() / energy[0]))
                yield f"{kernel} {'cup' if round_walls else 'box'} {solver}: {energy.max() / energy[0]:.5f}"
    energy = energies(dam_break("cubic_spline", 2.0, False, density_tolerance=0.01), 12000)
    yield f"energy after 6 s above that of a flat layer, over the first: {energy[-1] / energy[0] - 0.5:.4f}"
    yield "water at rest: speed [m/s] from 2 and from 2.5 s; error of the pressure, all and at walls"
    for dimension in (2, 3):
        for kernel, support in KERNELS:
            one, two, everywhere, near = at_rest(kernel, support, dimension)
            speeds[dimension, kernel] = one
            yield f"{dimension}-D {kernel}: {one:.3f} {two:.3f} m/s; {everywhere:.1%} {near:.1%}"
    printer.rows({"walls_work": [max(greatest)], "walls_rest": [speeds[2, "cubic_spline"]]})


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    rows.Printer.add_to(parser)
    for line in lines(rows.Printer(parser.parse_args())):
        print(line, flush=True)
