"""A film of fluid that flows down a slope, without slip."""

import numpy as np

from projected_flows import C2, PROJECTION, box, simulated
from scenes import box as walls

GRAVITY = 9.81
DEPTH = 0.4
"""[m]"""
NU = 0.1
"""[m2/s]"""


def sloping_film(slope, deep, solver=PROJECTION, device="cpu"):
    """The mean speed of a film, so many particles deep, over g sin(a) H^2 / (3 nu). The film is mixed on a slope of 0.1
    first. Also of each sixth of the time in which it is measured."""
    spacing = DEPTH / deep
    step = 0.2 * spacing**2 / NU
    diffusion = DEPTH**2 / NU

    def simulation(slope):
        size = np.sqrt(1.0 + slope**2)
        return simulated(
            spacing,
            discretisation=C2,
            phase=[{"name": "water", "rest_density": 1000.0, "viscosity": 1000.0 * NU}],
            fluid=[box([0.0, 0.0], [16.0 * spacing, DEPTH])],
            container=walls([0.0, 0.0], [16.0 * spacing, 2.0 * DEPTH], periodic=[True, False], slip="no"),
            forces={"gravity": [GRAVITY * slope / size, -GRAVITY / size], "viscosity": "stress"},
            solver={**solver, "time_step": step},
            device=device,
        )

    steep, flat = simulation(0.1), simulation(slope)
    mixed = steep.step(steep.state(), {}, steps=int(3.0 * diffusion / step))
    settled = flat.step(mixed, {}, steps=int(2.0 * diffusion / step))
    time = max(1.2 * NU / (GRAVITY * slope * DEPTH), 2.0 * diffusion)
    steps = int(time / step)
    run = flat.run(steps, state=settled, record_every=max(steps // 240, 1))
    rate = run.velocities[1:, :, 0].mean(axis=1) / (GRAVITY * slope / np.sqrt(1.0 + slope**2) * DEPTH**2 / (3.0 * NU))
    return rate.mean(), [part.mean() for part in np.array_split(rate, 6)]
