"""Films of mud, a Herschel-Bulkley fluid, that flow down slopes without slip."""

import numpy as np

from cortado import Simulation
from projected_flows import C2, PROJECTION, box, simulated

GRAVITY = 9.81
DEPTH = 0.1
"""[m]"""
TIME = 1.0
"""After which a film is looked at [s]; on gentle slopes it is steady then."""
SLOPES = (0.04, 0.08, 0.3)
LAW = {"viscosity": 40.0, "herschel_bulkley.flow_index": 0.6, "herschel_bulkley.yield_stress": 20.0}
"""[Pa s^n], [-], [Pa]"""
REGULARISATION = 2.0
"""[s]"""


def film(slope: float, deep: int) -> tuple[Simulation, int]:
    """A film at rest, so many particles deep, and how many steps it takes."""
    spacing, size = DEPTH / deep, np.sqrt(1.0 + slope**2)
    steps = int(np.ceil(TIME / (0.2 * spacing / 1.2)))
    consistency, index, stress = LAW.values()
    law = {"kind": "herschel_bulkley", "flow_index": index, "yield_stress": stress, "regularisation": REGULARISATION}
    sides = {"lower": [0.0, 0.0], "upper": [8.0 * spacing, 1.5 * DEPTH], "periodic": [True, False]}
    simulation = simulated(
        spacing,
        discretisation=C2,
        phase=[{"name": "water", "rest_density": 1000.0, "viscosity": consistency, "rheology": law}],
        fluid=[box([0.0, 0.0], [8.0 * spacing, DEPTH])],
        container={"shape": "box", **sides, "slip": "no"},
        forces={"gravity": [GRAVITY * slope / size, -GRAVITY / size], "viscosity": "stress"},
        solver={**PROJECTION, "time_step": TIME / steps},
    )
    return simulation, steps


def speeds(velocities: np.ndarray, heights: np.ndarray) -> np.ndarray:
    """(2,) the mean speed of all and of the uppermost eighth [m/s]."""
    return np.array([velocities[:, 0].mean(), velocities[heights > 7.0 / 8.0 * DEPTH, 0].mean()])


def observed(deep: int, law: dict[str, float], slopes: tuple[float, ...] = SLOPES) -> np.ndarray:
    """(2 slopes,) [m/s]"""
    found = []
    for slope in slopes:
        simulation, steps = film(slope, deep)
        run = simulation.run(steps, law, record_every=steps)
        found.append(speeds(run.velocities[-1], simulation.positions[:, 1]))
    return np.concatenate(found)


def steady_speeds(slope: float) -> np.ndarray:
    """(2,) of the closed form: the shear stress grows linearly downwards, and the law says how fast that shears."""
    consistency, index, stress = LAW.values()
    heights = (np.arange(2000) + 0.5) / 2000 * DEPTH
    rates = np.geomspace(1e-8, 1e4, 20_000)
    stresses = consistency * np.maximum(rates, 1e-3) ** (index - 1.0) * rates
    stresses += stress * (1.0 - np.exp(-REGULARISATION * rates))
    sheared = np.interp(1000.0 * GRAVITY * slope / np.sqrt(1.0 + slope**2) * (DEPTH - heights), stresses, rates)
    return speeds(np.cumsum(sheared)[:, None] * (DEPTH / 2000), heights)
