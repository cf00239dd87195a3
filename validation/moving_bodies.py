"""Bodies that settle, heave, heel and roll, and the water that goes along with them, for `validation/solids.py`."""

from typing import Any

import numpy as np
from scipy.optimize import brentq

from cortado import Scene, Simulation
from cortado.sensors import BodyMotion, SolidLoad
from floating_bodies import STEP, sinking
from scenes import box, pool


def added_mass(across: int, deep: int, settling: int, iterations: int, steps: int = 1) -> dict[str, float]:
    """A sphere so many particles across in the middle of water at rest, as wide as it is deep, between periodic sides:
    the mass of water that goes along with it over that of the water in its place.

    The water comes to rest, for ``settling`` steps, around a sphere of its own density. From there on the sphere has
    another one, and gets faster, in the mean of so many ``steps``, by g (rho - rho_0) / (rho + C rho_0) dt more a step
    than it would otherwise: of water without end C is 0.5."""
    spacing = 0.02
    side = deep * spacing
    middle, ball = [0.5 * side] * 3, {"name": "ball", "shape": "sphere", "motion": "free", "density": 1000.0}
    scene = Scene(
        dimension=3,
        discretisation={"spacing": spacing},
        phase=[{"name": "water", "rest_density": 1000.0, "viscosity": 1.0}],
        fluid=[{"shape": "box", "lower": [0.0] * 3, "upper": [side] * 3, "phase": "water"}],
        container=box([0.0] * 3, [side, side + 6.0 * spacing, side], periodic=[True, False, True]),
        solid=[{**ball, "centre": middle, "radius": 0.5 * across * spacing}],
        solver={"kind": "projection", "time_step": STEP, "iterations": iterations},
    )
    simulation = Simulation(scene)
    settled = simulation.run(settling, record_every=settling).last_state

    def faster(density: float) -> float:
        run = simulation.run(steps, controls={"ball.density": density}, state=settled, record_every=steps)
        first, last = run.solids["ball"].velocities[:, 1].astype(np.float64)
        return float(last - first) / (steps * STEP)

    alone = faster(1000.0)
    found: dict[str, float] = {"particles": len(simulation.positions)}
    for density in (500.0, 3000.0, 8000.0):
        # Water that is not quite at rest moves the ball too, and a heavier one less, with 0.5 for C in this small part.
        more = faster(density) - alone * 1500.0 / (density + 500.0)
        found[f"at {density:g} kg/m3"] = (-9.81 * (density - 1000.0) / more - density) / 1000.0
    return found


def settling_ball(
    across: int, wide: float, step: float, duration: float, device: str = "cpu", settling: float | None = None
) -> dict[str, float]:
    """A ball without slip, so many particles across and three times as heavy as syrup, that sinks along the axis of a
    tube ``wide`` times its size: as `settling_disc`, over the speed of Haberman and Sayre (1958)."""
    radius, viscosity, density = 0.05, 100.0, 3000.0
    spacing, high, k = 2.0 * radius / across, 6.0 * wide * radius, 1.0 / wide
    tube = {"shape": "cylinder", "axis": "y", "base": [0.0, 0.0, 0.0], "radius": wide * radius}
    ball = {"name": "ball", "shape": "sphere", "centre": [0.0, 0.55 * high, 0.0], "radius": radius, "slip": "no"}
    scene = Scene(
        dimension=3,
        discretisation={"spacing": spacing},
        phase=[{"name": "syrup", "rest_density": 1000.0, "viscosity": viscosity}],
        fluid=[{**tube, "height": high, "phase": "syrup"}],
        container={"shape": "none"},
        solid=[
            {"name": "tube", **tube, "height": high + 4.0 * spacing, "side": "inside", "slip": "no"},
            {**ball, "motion": "free", "density": density},
        ],
        solver={"kind": "projection", "time_step": step},
    )
    slower = (1.0 - 0.75857 * k**5) / (1.0 - 2.105 * k + 2.0865 * k**3 - 1.7068 * k**5 + 0.72603 * k**6)
    exact = 2.0 / 9.0 * (density - 1000.0) * 9.81 * radius**2 / (viscosity * slower)
    return sinking(scene, exact, duration, device, settling)


WIDE, DRAFT, TALL, KEEL, GYRATION = 0.4, 0.2, 0.3, 0.08, 0.25
"""Of a box with a keel's mass: its sides and draft, how far its mass is below its middle, and its gyration radius."""
TANK, DEPTH = 1.2, 0.6
"""Of the tank in whose middle it floats [m]."""
METACENTRE = 0.5 * DRAFT + WIDE**2 / (12.0 * DRAFT) - (0.5 * TALL - KEEL)
"""KB + BM - KG [m]."""


def keel(long: int, **keys: Any) -> Scene:
    """A box with a keel's mass, so many particles long, that floats upright but for these ``keys`` of its table and for
    ``higher`` [m]."""
    lower, spacing = DEPTH - DRAFT + keys.pop("higher", 0.0), WIDE / long
    raft = box([0.5 * (TANK - WIDE), lower], [0.5 * (TANK + WIDE), lower + TALL], name="raft", motion="free")
    mass = {"mass": 1000.0 * WIDE * DRAFT, "centre_of_mass": [0.0, -KEEL], "gyration_radius": GYRATION}
    table = {key: value for key, value in {**raft, **mass, **keys}.items() if value is not None}
    solver = {"kind": "projection", "time_step": 0.04 * spacing}
    return pool([TANK, DEPTH], [TANK, 1.2], spacing, 0.001, solid=[table], solver=solver)


def swinging_water(rate: float, rolls: bool, h: float = 0.01) -> float:
    """The added mass of the box that heaves, or its added inertia about its mass if it rolls, at a ``rate`` [rad/s]: by
    potential flow on cells of the size h, with phi_n = rate^2 / g phi at the surface; negative beyond a resonance of
    the tank."""
    from scipy.sparse import lil_matrix
    from scipy.sparse.linalg import spsolve

    columns, rows, below = round(TANK / h), round(DEPTH / h), round((DEPTH - DRAFT) / h)
    left, right = round(0.5 * (TANK - WIDE) / h), round(0.5 * (TANK + WIDE) / h)
    wet = np.ones((columns, rows), dtype=bool)
    wet[left:right, below:] = False
    numbers = np.full((columns, rows), -1)
    numbers[wet] = np.arange(wet.sum())
    matrix, faces = lil_matrix((wet.sum(), wet.sum())), []
    slope, middle = rate**2 / 9.81, np.array([0.5 * TANK, DEPTH - DRAFT + 0.5 * TALL - KEEL])
    for i, j in np.argwhere(wet):
        k = numbers[i, j]
        for normal in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            a, b = i + normal[0], j + normal[1]
            if b == rows:
                matrix[k, k] += h * slope / (1.0 - 0.5 * h * slope)
            elif 0 <= a < columns and b >= 0 and wet[a, b]:
                matrix[k, k] -= 1.0
                matrix[k, numbers[a, b]] += 1.0
            elif 0 <= a < columns and b >= 0:
                x, y = h * (np.array([i, j]) + 0.5 + 0.5 * np.array(normal)) - middle
                faces.append((k, np.dot((-y, x), normal) if rolls else float(normal[1])))
    flows = np.zeros(wet.sum())
    for k, speed in faces:
        flows[k] -= h * speed
    potential = spsolve(matrix.tocsr(), flows)
    return 1000.0 * h * float(sum((potential[k] + 0.5 * h * speed) * speed for k, speed in faces))


def swinging_rates(rolls: bool) -> list[float]:
    """The rates [rad/s] at which the box and the water in the tank swing by linear theory, the slowest first: one is
    that of the box, others those of waves which it makes."""
    mass = 1000.0 * WIDE * DRAFT * (GYRATION**2 if rolls else 1.0)
    stiffness = 9810.0 * WIDE * (DRAFT * METACENTRE if rolls else 1.0)

    def lack(rate: float) -> float:
        return stiffness - rate**2 * (mass + swinging_water(rate, rolls))

    rates = np.linspace(2.0, 9.0, 22)
    lacks = [lack(rate) for rate in rates]
    downwards = [k for k in range(21) if lacks[k] > 0.0 > lacks[k + 1]]  # upwards are resonances of the water
    return [float(brentq(lack, rates[k], rates[k + 1], rtol=1e-3)) for k in downwards]


def swings(times: np.ndarray, values: np.ndarray, rates: list[float]) -> tuple[np.ndarray, np.ndarray]:
    """The rates of damped swings that add up to the values best, beginning from some, and their sizes."""
    from scipy.optimize import least_squares

    def parts(rates_and_dampings: np.ndarray) -> np.ndarray:
        rates, dampings = rates_and_dampings.reshape(2, -1)
        waves = np.exp(-np.outer(times, np.abs(dampings) + 1j * rates))
        return np.hstack([waves.real, waves.imag, np.ones((len(times), 1))])

    def left(given: np.ndarray) -> np.ndarray:
        matrix = parts(given)
        return np.asarray(values - matrix @ np.linalg.lstsq(matrix, values)[0])

    found = least_squares(left, np.concatenate([rates, np.full(len(rates), 0.1)])).x
    sizes = np.linalg.lstsq(parts(found), values)[0][:-1].reshape(2, -1)
    return found[: len(rates)], np.hypot(*sizes)


def swinging_box(long: int, rolls: bool, duration: float = 4.0, device: str = "cpu") -> dict[str, float]:
    """The box with its keel's mass, so many particles long, that may only heave or only roll, and is let go 0.02 m too
    high or turned by 0.1 rad: the period of its largest swing in so many seconds over that of linear theory in the same
    tank, and the part of that swing in all."""
    keys: dict[str, Any] = {"freedom": ["rotation" if rolls else "y"]}
    keys |= {"rotation": 0.1} if rolls else {"higher": 0.02}
    simulation = Simulation(keel(long, **keys), device)
    steps = round(duration / simulation.scene.solver.time_step)
    run = simulation.run(steps, record_every=steps, sensors={"body": BodyMotion("raft")})
    values = run.sensors["body"]["rotation" if rolls else "y"].astype(np.float64)
    theory, late = swinging_rates(rolls), len(values) // 16
    rates, sizes = swings((duration / steps * np.arange(len(values)))[late::8], values[late::8], theory)
    largest = int(sizes.argmax())
    return {
        "particles": len(simulation.positions),
        "period": 2.0 * np.pi / rates[largest],
        "period over the exact one": theory[largest] / rates[largest],
        "part of this swing": float(sizes[largest] / sizes.sum()),
    }


def heeled_box(long: int, heel: float = 0.06, duration: float = 1.0, device: str = "cpu") -> dict[str, float]:
    """GM from the moment of water at rest on the box that is held at an angle [rad] to either side, over its weight and
    the angle, beside KB + BM - KG of hydrostatics."""
    moments = []
    for angle in (heel, -heel):
        still = dict.fromkeys(("mass", "centre_of_mass", "gyration_radius"))
        scene = keel(long, motion="path", velocity=[0.0, 0.0], rotation=angle, **still)
        simulation, step = Simulation(scene, device), scene.solver.time_step
        steps = round(duration / step)
        run = simulation.run(steps, record_every=steps, sensors={"load": SolidLoad("raft")})
        moments.append(float(run.sensors["load"]["torque"][steps // 2 :].mean()))
    found = (moments[1] - moments[0]) / (2.0 * heel * 9810.0 * WIDE * DRAFT) + KEEL
    return {"GM": found, "GM over KB + BM - KG": found / METACENTRE}


def rolling_under_oil(across: int, flat: bool = True, duration: float = 0.6, device: str = "cpu") -> dict[str, float]:
    """A disc, or a ball, without slip, so many particles across and three times as heavy as oil, that rolls down a
    slope of 0.3 rad under it: how fast it turns at the end over its speed over its radius, how far it has gone in
    radii, and how deep its surface was in the slope and how far off it, in spacings."""
    lean, radius, d = 0.3, 0.05, 2 if flat else 3
    normal, spacing = np.array([np.sin(lean), np.cos(lean), 0.0]), 2.0 * radius / across
    foot = np.array([0.0, 0.35, 0.0])
    start = foot + 0.15 * np.array([1.0, -np.tan(lean), 0.0]) + (radius + 1e-4) * normal + [0.0, 0.0, 0.1]
    oil, step = [{"name": "oil", "rest_density": 900.0, "viscosity": 0.1}], 0.04 * spacing
    ball = {"name": "ball", "shape": "sphere", "centre": start[:d].tolist(), "radius": radius, "slip": "no"}
    slope = {"name": "slope", "shape": "plane", "position": foot[:d].tolist(), "normal": normal[:d].tolist()}
    scene = Scene(
        dimension=d,
        discretisation={"spacing": spacing},
        phase=oil,
        fluid=[box([0.0] * d, [1.0, 0.5, 0.2][:d], phase="oil")],
        container=box([0.0] * d, [1.0, 0.7, 0.2][:d], periodic=[False, False, True][:d]),
        solid=[{**slope, "slip": "no"}, {**ball, "motion": "free", "density": 2700.0, "friction": 0.5}],
        solver={"kind": "projection", "time_step": step},
    )
    simulation, steps = Simulation(scene, device), round(duration / step)
    body = simulation.run(steps, record_every=max(steps // 200, 1)).solids["ball"]
    away = (body.positions - foot[:d]) @ normal[:d] - radius
    speeds = np.linalg.norm(body.velocities, axis=1)
    turns = np.abs(body.angular_velocities if flat else body.angular_velocities[:, 2])
    return {
        "particles": len(simulation.positions),
        "turning over rolling": float(radius * turns[-20:].sum() / speeds[-20:].sum()),
        "radii gone": float(np.linalg.norm(body.positions[-1] - body.positions[0]) / radius),
        "deepest [spacings]": float(-away.min() / spacing),
        "highest [spacings]": float(away.max() / spacing),
        "speed [m/s]": float(speeds[-1]),
    }
