"""Fluids at rest in a tank: water, and light fluid over heavy fluid."""

from typing import NamedTuple

import numpy as np

from projected_flows import C2, PROJECTION, box, simulated

GRAVITY = 9.81


def tank(dimension=2):
    """Tables of a tank 0.8 m wide, and as long in space, and of gravity."""
    container = {"shape": "box", "lower": [0.0] * dimension, "upper": [0.8, 1.4, 0.8][:dimension]}
    return {"container": container, "forces": {"gravity": [0.0, -GRAVITY, 0.0][:dimension]}}


class PressureErrors(NamedTuple):
    """Rms errors of mean pressures over rho g H."""

    all: float
    inside: float
    """Of particles 3 spacings and more away from walls and surface."""
    near_walls: float
    """Of those nearer to walls."""


class StillWater(NamedTuple):
    """A metre of water in the last fifth of a time."""

    speed: float
    """Rms [m/s]."""
    pressure: PressureErrors
    multiplier: PressureErrors
    """The same of k / dt."""
    level: float
    """The mean height over that at first, at the end."""


def still_water(deep, time=2.5, discretisation=C2, device="cpu", dimension=2):
    """Of water so many particles deep."""
    spacing = 1.0 / deep
    simulation = simulated(
        spacing,
        dimension,
        precision="float32",
        discretisation=discretisation,
        phase=[{"name": "water", "rest_density": 1000.0, "viscosity": 0.001}],
        fluid=[box([0.0] * dimension, [0.8, 1.0, 0.8][:dimension])],
        solver={**PROJECTION, "time_step": 0.001},
        device=device,
        **tank(dimension),
    )
    steps = round(time / 0.001)
    run = simulation.run(steps, record_every=max(steps // 500, 1), record=["pressure"])
    late = run.times > 0.8 * time
    x = run.positions[late].mean(axis=0)
    depth, edge = len(x) * spacing**dimension / 0.8 ** (dimension - 1), 3.0 * spacing
    sides = np.delete(x, 1, axis=1)
    walls = ((sides < edge) | (sides > 0.8 - edge)).any(axis=1) | (x[:, 1] < edge)
    places = (np.full(len(x), True), ~walls & (x[:, 1] < depth - edge), walls)

    def errors(pressures):
        found = pressures[late].mean(axis=0) / (1000.0 * GRAVITY * depth) - (depth - x[:, 1]) / depth
        return PressureErrors(*(float(np.sqrt((found[place] ** 2).mean())) for place in places))

    speed = np.sqrt((run.velocities[late] ** 2).sum(axis=2).mean())
    level = run.positions[-1, :, 1].mean() / run.positions[0, :, 1].mean()
    multiplier = errors(run.others["pressure_impulse"] / 0.001)
    return StillWater(float(speed), errors(run.quantities["pressure"]), multiplier, float(level))


def two_layers(ratio, time_step, deep=40, time=2.0, solver=PROJECTION, discretisation=C2, device="cpu"):
    """Light fluid over one so many times as heavy, half a metre each: the rms of the speed within 4 spacings of where
    they meet in the second half of the time, over sqrt(g H)."""
    spacing = 1.0 / deep
    densities = {"heavy": 1000.0, "light": 1000.0 / ratio}
    bodies = [box([0.0, 0.0], [0.8, 0.5]) | {"phase": "heavy"}, box([0.0, 0.5], [0.8, 1.0]) | {"phase": "light"}]
    simulation = simulated(
        spacing,
        precision="float32",
        discretisation=discretisation,
        phase=[{"name": n, "rest_density": rho, "viscosity": 1e-6 * rho} for n, rho in densities.items()],
        fluid=bodies,
        solver={**solver, "time_step": time_step},
        device=device,
        **tank(),
    )
    steps = round(time / time_step)
    run = simulation.run(steps, record_every=max(steps // 200, 1))
    late = run.times > 0.5 * time
    near = np.abs(run.positions[late][:, :, 1] - 0.5) < 4.0 * spacing
    return float(np.sqrt((run.velocities[late] ** 2).sum(axis=2)[near].mean()) / np.sqrt(GRAVITY))
