"""Standing waves of small amplitude, whose frequency and damping are known (Lamb 1932)."""

from typing import NamedTuple

import numpy as np

from projected_flows import C2, PROJECTION, box, simulated

GRAVITY = 9.81
DEPTH = 0.5


class StandingWave(NamedTuple):
    """What was found of a wave."""

    frequency: float
    """Over sqrt(g k tanh(k H))."""
    decay: float
    """Of its amplitude [1/s]."""
    damping: float
    """The decay over 2 nu k^2, which is Lamb's of deep water."""


def standing_wave(
    deep, wavelength=2.0, walls=False, viscosity=0.003, periods=2.5, solver=PROJECTION, time_step=0.003, device="cpu"
):
    """A wave in water so many particles deep, whose length is given in depths, with walls that slip half a wave apart,
    or in one wave that repeats. Its steepness is 0.09, and ``viscosity`` is nu [m2/s]."""
    from scipy.optimize import curve_fit

    spacing, length = DEPTH / deep, wavelength * DEPTH
    k = 2.0 * np.pi / length
    wide, frequency = length / 2.0 if walls else length, np.sqrt(GRAVITY * k * np.tanh(k * DEPTH))
    simulation = simulated(
        spacing,
        precision="float32",
        discretisation=C2,
        phase=[{"name": "water", "rest_density": 1000.0, "viscosity": 1000.0 * viscosity}],
        fluid=[box([0.0, 0.0], [wide, DEPTH])],
        container={"shape": "box", "lower": [0.0, 0.0], "upper": [wide, 1.6 * DEPTH], "periodic": [not walls, False]},
        forces={"gravity": [0.0, -GRAVITY], "viscosity": "stress"},
        solver={**solver, "time_step": time_step},
        device=device,
    )

    def mode(x):
        a, b = k * x[..., 0], k * x[..., 1]
        flow = np.stack([np.sin(a) * np.cosh(b), -np.cos(a) * np.sinh(b)], axis=-1)
        return flow / np.cosh(k * DEPTH)

    x = simulation.positions
    x = x + 0.05 * spacing * np.random.default_rng(1).uniform(-1.0, 1.0, x.shape)
    first = {"initial_positions": x, "initial_velocities": 0.09 * frequency / k / np.tanh(k * DEPTH) * mode(x)}
    run = simulation.run(round(periods * 2.0 * np.pi / frequency / time_step), first, record_every=4)
    flow = mode(run.positions)
    speed = (run.velocities * flow).sum((1, 2)) / (flow**2).sum((1, 2))

    def swings(t, amplitude, decay, rate, phase):
        return amplitude * np.exp(-decay * t) * np.cos(rate * t + phase)

    decay, rate = curve_fit(swings, run.times, speed, [speed[0], 0.1, frequency, 0.0])[0][1:3]
    return StandingWave(rate / frequency, decay, decay / (2.0 * viscosity * k**2) if viscosity else np.nan)
