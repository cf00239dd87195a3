"""Drops that oscillate in the plane and in space, and how they should."""

from math import cos, pi, radians, sin, sqrt

import numpy as np
from scipy.optimize import curve_fit, fsolve
from scipy.special import ive

from cortado import Scene, Simulation
from cortado.rollout.parameter_space import ParameterSpace
from scenes import box

C2 = {"kernel": "wendland_c2", "support": 2.6}
CUBIC = {"kernel": "cubic_spline", "support": 2.0}
C4 = {"kernel": "wendland_c4", "support": 3.0}
PROJECTION = {"kind": "projection"}
PCISPH = {"kind": "pcisph", "density_tolerance": 0.001, "maximum_iterations": 100}


def exact_mode(ohnesorge: float, dimension: int = 2) -> tuple[float, float]:
    """Frequency and damping of a drop, in units of sqrt(sigma / (rho R^3)); the Ohnesorge number is mu / sqrt(rho sigma
    R).

    In the plane the root of the linear problem with viscosity: a potential flow and one of vorticity, without shear
    stress at the surface (Lamb 1932, art. 355, on a sphere). In space, for small viscosity, Lamb's.
    """
    n, nu = 2, ohnesorge
    if dimension == 3:
        damping, free = (n - 1) * (2 * n + 1) * nu, n * (n - 1) * (n + 2)
        return sqrt(free - damping**2), damping

    def residual(z):
        rate = z[0] + 1j * z[1]
        k = np.sqrt(rate / nu)
        slope = 0.5 * (ive(n - 1, k) + ive(n + 1, k)) / ive(n, k)  # of the Bessel function over itself
        b = -2 * n * (n - 1) / (k * k + 2 * n * n - 2 * k * slope)
        f, f_slope = 1 + b, n + b * k * slope
        value = rate * rate + 2 * nu * n * rate * (f_slope - f) + n * (n * n - 1) * f
        return [value.real, value.imag]

    root = fsolve(residual, [-2 * n * (n - 1) * nu, sqrt(n**3 - n)], xtol=1e-13)
    return float(root[1]), float(-root[0])


def disc_of_lattice(spacing, discretisation, dimension):
    """Points of a lattice of that spacing in a disc or ball of radius 1."""
    across = round(2.0 / spacing)
    line = spacing * (np.arange(-across, across) + 0.5)
    x = np.stack(np.meshgrid(*[line] * dimension, indexing="ij"), axis=-1).reshape(-1, dimension)
    return x[(x**2).sum(axis=1) < 1.0]


def packed_disc(spacing, discretisation, dimension):
    """The particles of the fluid that a scene has in a disc or ball of radius 1."""
    water = {"name": "water", "rest_density": 1.0, "viscosity": 0.0}
    ball = {"shape": "sphere", "centre": [0.0] * dimension, "radius": 1.0, "phase": "water"}
    made = {
        "dimension": dimension,
        "discretisation": {"spacing": spacing, **discretisation},
        "solver": {"kind": "pcisph", "time_step": 0.001},
    }
    return Simulation(Scene(**made, phase=[water], fluid=[ball]), precision="float64").positions


def swing(t, a, b, frequency, damping, offset):
    return np.exp(-damping * t) * (a * np.cos(frequency * t) + b * np.sin(frequency * t)) + offset


class Drop:
    """A drop of radius, density and surface tension of about 1, drawn out by a part of its radius, along a run."""

    def __init__(
        self,
        across,
        turned=0.0,
        ohnesorge=0.1,
        discretisation=C2,
        solver=PROJECTION,
        dimension=2,
        drawn=0.08,
        jitter=0.0,
        periods=2.0,
        step=0.2,
        slope=False,
        precision="float64",
        particles=disc_of_lattice,
        **forces,
    ):
        """``turned``: its ``particles`` by an angle [degrees]; ``periods`` of its oscillation; with its ``slope``, the
        tangent with respect to the surface tension is computed too."""
        spacing, d = 2.0 / across, dimension
        x = particles(spacing, discretisation, d)
        turn, angle = np.eye(d), radians(turned)
        turn[:2, :2] = [[cos(angle), -sin(angle)], [sin(angle), cos(angle)]]
        x = x @ turn.T
        x = x + jitter * spacing * np.random.default_rng(1).uniform(-1.0, 1.0, x.shape)
        x -= x.mean(axis=0)
        self.radius = (len(x) * spacing**d / (pi if d == 2 else 4.0 * pi / 3.0)) ** (1.0 / d)
        self.unit = self.radius**1.5
        """Of time."""
        x *= (1.0 + drawn) ** np.r_[1.0, -np.full(d - 1, 1.0 / (d - 1))]
        self.ohnesorge, self.dimension = ohnesorge, d
        self.exact = exact_mode(ohnesorge, d)
        time_step = min(step * spacing**1.5, 0.15 * spacing**2 / max(ohnesorge, 1e-9))
        self.steps = round(periods * 2.0 * pi / self.exact[0] * self.unit / time_step)
        self.simulation = Simulation(
            Scene(
                dimension=d,
                discretisation={"spacing": spacing, **discretisation},
                phase=[{"name": "water", "rest_density": 1.0, "viscosity": ohnesorge * sqrt(self.radius)}],
                fluid=[box([0.0] * d, [len(x) * spacing] + [spacing] * (d - 1), phase="water")],
                forces={"gravity": [0.0] * d, "surface_tension": 1.0, **forces},
                solver={**solver, "time_step": time_step},
            ),
            precision=precision,
        )
        assert len(self.simulation.positions) == len(x)
        values = self.simulation.parameters() | {"initial_positions": x}  # a row of as many particles, put in place
        self.rows, self.slopes, self._states = [], [], {}
        rollout = self.simulation.rollout(self.steps, values)
        rollout.forward(self._look, keep=slope)
        self.time, self.stretch, self.speed, self.pressure, self.drift, self.turning = np.array(self.rows).T
        if slope:
            space = ParameterSpace(self.simulation, self.steps)
            along = {name: np.zeros_like(value) for name, value in values.items()} | {"surface_tension": np.array(1.0)}
            rollout.tangent(*space.direction(rollout, values, along), self._look_along)
            self.stretch_slope = np.array(self.slopes)

    def _look(self, step, state):
        if step % max(self.steps // 200, 1):
            return
        fields = state.numpy(self.dimension)
        x, v = fields["positions"], fields["velocities"]
        self._states[step] = x
        x = x - x.mean(axis=0)
        squares, inside = (x**2).mean(axis=0), np.linalg.norm(x, axis=1) < 0.5
        impulse = fields.get("pressure_impulse")
        pressure = 0.0 if impulse is None else impulse[inside].mean() / self.simulation.scene.solver.time_step
        turning = (x[:, 0] * v[:, 1] - x[:, 1] * v[:, 0]).mean()
        self.rows.append(
            (
                step * self.simulation.scene.solver.time_step / self.unit,
                (squares[0] - squares[1:].mean()) / squares.sum(),
                sqrt((v**2).sum(axis=1).mean()),
                pressure * self.radius / (self.dimension - 1),
                float(np.linalg.norm(v.mean(axis=0))),
                turning,
            )
        )

    def _look_along(self, step, dot):
        if step not in self._states:
            return
        x, x_dot = self._states[step], dot.numpy(self.dimension)["positions"]
        x, x_dot = x - x.mean(axis=0), x_dot - x_dot.mean(axis=0)
        squares, change = (x**2).mean(axis=0), 2.0 * (x * x_dot).mean(axis=0)
        part = (squares[0] - squares[1:].mean()) / squares.sum()
        self.slopes.append((change[0] - change[1:].mean() - part * change.sum()) / squares.sum())

    def fit(self):
        """Frequency and damping over exact ones, and the rest over the first stretch."""
        used = self.time > 0.3
        start = [self.stretch[0], 0.0, *self.exact, 0.0]
        self.found, _ = curve_fit(swing, self.time[used], self.stretch[used], start, maxfev=20000)
        rest = swing(self.time, *self.found) - self.stretch
        frequency, damping = self.found[2:4] / self.exact
        return float(frequency), float(damping), float(np.sqrt((rest[used] ** 2).mean()) / abs(self.stretch[0]))

    def frequency_slope(self):
        """d omega / d sigma by the tangent, over the exact one; after `fit`."""
        used, t, size = self.time > 0.3, self.time, 1e-5
        changes = [
            (swing(t, *(self.found + size * unit)) - swing(t, *(self.found - size * unit))) / (2.0 * size)
            for unit in np.eye(5)
        ]
        rates, *_ = np.linalg.lstsq(np.array(changes).T[used], self.stretch_slope[used], rcond=None)
        # omega = F(Oh) sqrt(sigma), and Oh goes with 1 / sqrt(sigma)
        more, less = (exact_mode(self.ohnesorge * (1.0 + e) ** -0.5)[0] * (1.0 + e) ** 0.5 for e in (1e-4, -1e-4))
        return float(rates[2] / ((more - less) / 2e-4))
