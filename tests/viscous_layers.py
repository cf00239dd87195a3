"""Two fluids in layers that shear each other, and viscosity as a stress once more, in NumPy with any mean."""

from collections.abc import Callable

import numpy as np

from cortado import Simulation
from cortado.discretise.smoothing import stress_control
from scenes import box
from viscous_flows import DENSITY, NU, VISCOSITY, acceleration, simulation

BAND = 0.05
"""From the middle of a layer, so far does reach what pushes it [m]."""
Force = Callable[[np.ndarray], np.ndarray]


def two_layers(across: int, ratio: float, form: str = "stress") -> Simulation:
    """A square of 1 m whose upper half is so many times as viscous as its lower one, periodic both ways; its particles
    are 10 abreast."""
    long, spacing = 10.0 / across, 1.0 / across
    phases = [
        {"name": name, "rest_density": DENSITY, "viscosity": mu}
        for name, mu in (("thin", VISCOSITY), ("thick", ratio * VISCOSITY))
    ]
    layers = [box([0.0, low], [long, low + 0.5], phase=name) for name, low in (("thin", 0.0), ("thick", 0.5))]
    step = {"kind": "pcisph", "time_step": 0.05 * spacing**2 / (ratio * NU)}
    return simulation([long, 1.0], spacing, form=form, phase=phases, fluid=layers, solver=step)


def pushes(y: np.ndarray) -> np.ndarray:
    """[m/s2] along x: the thin layer forwards and the thick one back, in a band in the middle of each, so that the
    shear stress is the same everywhere else."""
    return np.where(np.abs(y - 0.25) < BAND, 1.0, 0.0) - np.where(np.abs(y - 0.75) < BAND, 1.0, 0.0)


def exact(y: np.ndarray, ratio: float) -> np.ndarray:
    """Velocities [m/s] of the closed form, 0 where the thin layer ends at y = 1/2."""
    fine = np.linspace(0.25, 0.75, 50001)
    stress = -BAND * np.minimum(np.minimum((fine - 0.25) / BAND, (0.75 - fine) / BAND), 1.0)  # over the density
    slope = stress / np.where(fine < 0.5, NU, ratio * NU)
    u = np.concatenate([[0.0], np.cumsum(0.5 * (slope[1:] + slope[:-1]) * np.diff(fine))])
    u -= np.interp(0.5, fine, u)
    mirrored = np.where(y < 0.25, 0.5 - y, np.where(y > 0.75, 1.5 - y, y))
    return np.interp(mirrored, fine, u)


def profile(one: Simulation, force: Force) -> tuple[np.ndarray, np.ndarray]:
    """Heights [m] and velocities [m/s] of the steady flow of rows that stay where they are, apart from a velocity of
    all; ``force`` gives accelerations along x (n,) for velocities along x."""
    rows, row = np.unique(one.positions[:, 1].round(9), return_inverse=True)
    columns = [np.bincount(row, force((row == k).astype(float))) / np.bincount(row) for k in range(len(rows))]
    return rows, np.linalg.lstsq(np.array(columns).T, -pushes(rows), rcond=None)[0]


def profile_error(one: Simulation, ratio: float, force: Force) -> float:
    """Its greatest error over the difference of the greatest and the least velocity."""
    rows, u = profile(one, force)
    wanted = exact(rows, ratio)
    away = u - wanted
    return float(np.abs(away - away.mean()).max() / np.ptp(wanted))


def by_engine(one: Simulation) -> Force:
    """Accelerations that the engine gives."""

    def force(u: np.ndarray) -> np.ndarray:
        return acceleration(one, one.positions, np.column_stack([u, np.zeros(len(u))]))[:, 0]

    return force


def by_hand(one: Simulation, mean: str) -> Force:
    """The same in NumPy, in the plane, with the "harmonic" or the "arithmetic" mean of the viscosities between a
    particle and its neighbours."""
    cut, volume = one.scene.discretisation, one.lattice.volume
    lengths = np.array(one.scene.container.upper)
    x = one.positions[:, None] - one.positions[None, :]
    x -= lengths * np.round(x / lengths)
    square = (x**2).sum(axis=-1)
    np.fill_diagonal(square, 1.0)
    s = -volume * (one.smoothing.gradient(x.reshape(-1, 2), cut.support_radius).reshape(x.shape) * x).sum(-1) / square
    np.fill_diagonal(s, 0.0)
    fractions = one.initial.numpy(2)["mass_fractions"]
    mu = fractions @ np.array([phase.viscosity for phase in one.scene.phase])
    control = stress_control(one.smoothing, cut.spacing, cut.support_radius, 2)
    M = np.einsum("ij,ija,ijb->iab", s, x, x)

    def around(values: np.ndarray) -> np.ndarray:
        return 0.5 * np.einsum("ij,ij,j->i", s, (x**2).sum(-1), values) / np.trace(M, axis1=1, axis2=2)

    eta = 0.5 * mu + around(mu) if mean == "arithmetic" else 1.0 / (0.5 / mu + around(1.0 / mu))
    inverse = np.linalg.inv(M)

    def force(u: np.ndarray) -> np.ndarray:
        v = np.stack([u[:, None] - u[None, :], np.zeros_like(s)], axis=-1)
        G = np.einsum("ij,ija,ijb->iab", s, v, x) @ inverse
        T = eta[:, None, None] * ((G + G.transpose(0, 2, 1)) @ inverse - control * G)
        pull = np.einsum("ijab,ijb->ija", T[:, None] + T[None, :], x)
        pull += control * (eta[:, None] + eta[None, :])[..., None] * v
        return -np.einsum("ij,ija->ia", s, pull)[:, 0] / DENSITY

    return force
