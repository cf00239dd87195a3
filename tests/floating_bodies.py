"""How deep does a body float, and how much water goes along with one that gets faster?"""

from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from scipy.optimize import brentq
from scipy.special import j1, jvp, y1, yvp

from cortado import Scene, Simulation
from cortado.sensors import BodyMotion, SolidLoad
from scenes import box, pool

STEP = 0.001
"""Of the time in which a sphere gets faster [s]."""


def floating_box(long: int) -> dict[str, float]:
    """A box of half the density of water, half as high as it is long, that is let go at the height at which it should
    float: its draft over that, the mean of the second half of a run. ``long``: its particles along; ``duration`` in
    seconds, for a box of 0.4 m."""
    spacing, density, sides = 0.4 / long, 500.0, np.array([0.4, 0.2])
    wanted = density / 1000.0 * sides[1]
    step = 0.04 * spacing
    solid = box([0.3, 0.4 - wanted], [0.7, 0.4 - wanted + sides[1]], name="box", motion="free", density=density)
    solver = {"kind": "projection", "time_step": step}
    simulation = Simulation(pool([1.0, 0.4], [1.0, 1.0], spacing, 5.0, solid=[solid], solver=solver))
    steps = int(1.5 / step)
    run = simulation.run(steps, record_every=max(steps // 200, 1))
    level = len(simulation.positions) * spacing**2 + density / 1000.0 * np.prod(sides)
    drafts = level - (run.solids["box"].positions[:, 1] - 0.5 * sides[1])
    return {
        "particles": len(simulation.positions),
        "draft over the exact one": float(drafts[len(drafts) // 2 :].mean() / wanted),
    }


def rings(file: str, inner: float, outer: float, spacing: float) -> None:
    """Write particles in rings between two radii about 0."""
    radii = np.arange(inner + 0.5 * spacing, outer, spacing)
    angles = [2.0 * np.pi * (np.arange(n) + 0.3 * n) / n for n in np.round(2.0 * np.pi * radii / spacing)]
    made = [r * np.stack([np.cos(angle), np.sin(angle)], axis=1) for r, angle in zip(radii, angles, strict=True)]
    np.save(file, np.concatenate(made))


def disc_in_a_round_tank(
    density: float, file: str, spacing: float, steps: int, freedom: Any = None, **solver: Any
) -> np.ndarray:
    """How much faster a disc of the radius a = 0.15 m gets in each step, in the middle of a round tank of the radius
    b = 0.45 m that is full of water in rings, which a ``file`` takes on: over g (rho_0 - rho) / (rho + C rho_0) with
    the added mass C = (b^2 + a^2) / (b^2 - a^2) of theory."""
    inner, outer = 0.15, 0.45
    rings(file, inner, outer, spacing)
    round_about = {"shape": "sphere", "centre": [0.0, 0.0]}
    scene = Scene(
        dimension=2,
        discretisation={"spacing": spacing},
        phase=[{"name": "water", "rest_density": 1000.0, "viscosity": 0.001}],
        fluid=[{"shape": "points", "file": file, "phase": "water"}],
        container={"shape": "none"},
        solid=[
            {"name": "tank", **round_about, "radius": outer, "side": "inside"},
            {"name": "disc", **round_about, "radius": inner, "motion": "free", "density": density, "freedom": freedom},
        ],
        solver={"kind": "projection", "time_step": STEP, **solver},
    )
    faster = np.diff(Simulation(scene, precision="float64").run(steps, record_every=1).solids["disc"].velocities[:, 1])
    part = (outer**2 + inner**2) / (outer**2 - inner**2)
    found: np.ndarray = faster / (9.81 * STEP * (1000.0 - density) / (density + 1000.0 * part))
    return found


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


def stopping_wave_number(inner: float, outer: float, density: float, viscosity: float) -> float:
    """k [1/m] of the slowest way in which a turning cylinder in a fluid of 1000 kg/m3, within a cylinder at rest, comes
    to rest, at the rate nu k^2: that of velocities J_1(k r) Y_1(k b) - Y_1(k r) J_1(k b) whose torque on it takes its
    angular momentum."""

    def lack(k: float) -> float:
        at, slope = _mode(k * inner, k * outer), _mode_slope(k * inner, k * outer)
        rate = viscosity / 1000.0 * k**2
        return float(0.25 * rate * density * inner * at + viscosity * (k * slope - at / inner))

    ks = np.linspace(1e-3, np.pi / (outer - inner), 400)
    signs = np.sign([lack(k) for k in ks])
    first = int(np.argmax(signs != signs[0]))
    return float(brentq(lack, ks[first - 1], ks[first]))


def _mode(x: Any, b: float) -> Any:
    return j1(x) * y1(b) - y1(x) * j1(b)


def _mode_slope(x: float, b: float) -> Any:
    return jvp(1, x) * y1(b) - yvp(1, x) * j1(b)


def stopping_cylinder(across: int, density: float = 8000.0, viscosity: float = 30.0) -> dict[str, float]:
    """A cylinder without slip, so many particles across, that turns in a round tank of three times its radius, full of
    syrup that goes along: the rate at which it stops over that of theory."""
    inner, outer, step, steps = 0.15, 0.45, 0.005, 60
    k = stopping_wave_number(inner, outer, density, viscosity)
    with TemporaryDirectory() as folder:
        rings(f"{folder}/rings.npy", inner, outer, 2.0 * inner / across)
        round_about = {"shape": "sphere", "centre": [0.0, 0.0], "slip": "no"}
        disc = {"name": "disc", **round_about, "radius": inner, "motion": "free", "density": density}
        scene = Scene(
            dimension=2,
            discretisation={"spacing": 2.0 * inner / across},
            phase=[{"name": "syrup", "rest_density": 1000.0, "viscosity": viscosity}],
            fluid=[{"shape": "points", "file": f"{folder}/rings.npy", "phase": "syrup"}],
            container={"shape": "none"},
            solid=[
                {"name": "tank", **round_about, "radius": outer, "side": "inside"},
                {**disc, "angular_velocity": 1.0},
            ],
            forces={"gravity": [0.0, 0.0]},
            solver={"kind": "projection", "time_step": step},
        )
        simulation = Simulation(scene, precision="float64")
        x, y = simulation.positions.T
        r = np.hypot(x, y)
        speed = inner * _mode(k * r, k * outer) / _mode(k * inner, k * outer)
        first = {"initial_velocities": (speed / r)[:, None] * np.stack([-y, x], axis=1)}
        turning = simulation.run(steps, first, record_every=1).solids["disc"].angular_velocities
    late = np.log(turning[steps // 3 :])
    rate, exact = -np.polyfit(step * np.arange(len(late)), late, 1)[0], viscosity / 1000.0 * k**2
    return {"particles": len(simulation.positions), "rate over the exact one": float(rate / exact)}


def settling_disc(across: int, step: float, duration: float, device: str = "cpu") -> dict[str, float]:
    """A disc without slip, so many particles across and three times as heavy as syrup, that sinks in it midway
    between two walls three times its diameter apart: its speed in the last quarter of a ``duration`` [s] over that of
    Faxen (1946), and by how much of that it swings about its course there."""
    radius, viscosity, density, wide, high = 0.05, 100.0, 3000.0, 0.3, 0.6
    disc = {"name": "disc", "shape": "sphere", "centre": [0.5 * wide, 0.6 * high], "radius": radius, "slip": "no"}
    spacing = 2.0 * radius / across
    scene = Scene(
        dimension=2,
        discretisation={"spacing": spacing},
        phase=[{"name": "syrup", "rest_density": 1000.0, "viscosity": viscosity}],
        fluid=[box([0.0, 0.0], [wide, high], phase="syrup")],
        container=box([0.0, 0.0], [wide, high + 4.0 * spacing], slip="no"),
        solid=[{**disc, "motion": "free", "density": density}],
        solver={"kind": "projection", "time_step": step},
    )
    k = 2.0 * radius / wide
    part = -np.log(k) - 0.9157 + 1.7244 * k**2 - 1.7302 * k**4 + 2.4056 * k**6 - 4.5913 * k**8
    return sinking(scene, (density - 1000.0) * 9.81 * radius**2 * part / (4.0 * viscosity), duration, device)


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


def sinking(
    scene: Scene, exact: float, duration: float, device: str, settling: float | None = None
) -> dict[str, float]:
    """How fast the free body of a scene, 0.1 m across in syrup of 0.1 m2/s, sinks in the last quarter of a run, over an
    ``exact`` speed [m/s], and by how much of that it swings about its course. Before that the body is as heavy as the
    syrup, for ``settling`` [s] or as long as the run: where a surface cuts the lattice there is room, and particles of
    syrup fill it slowly."""
    name, density = next((solid.name, solid.density) for solid in scene.solid if solid.motion == "free")
    simulation, steps = Simulation(scene, device, precision="float64"), round(duration / scene.solver.time_step)
    first = steps if settling is None else round(settling / scene.solver.time_step)
    settled = simulation.run(first, {f"{name}.density": 1000.0}, record_every=first)
    run = simulation.run(
        steps,
        {f"{name}.density": density},
        state=settled.last_state,
        record_every=steps,
        sensors={"body": BodyMotion(name)},
    )
    late = run.sensors["body"]["velocity_y"][3 * steps // 4 :]
    course = np.polyval(np.polyfit(np.arange(len(late)), late, 2), np.arange(len(late)))
    return {
        "particles": len(simulation.positions),
        "Reynolds number": exact,
        "speed over the exact one": float(-late.mean() / exact),
        "swing": float(np.abs(late - course).max() / exact),
    }


def passing(times: np.ndarray, heights: np.ndarray) -> np.ndarray:
    """When something that swings goes through 0 upwards."""
    k = np.nonzero((heights[:-1] < 0.0) & (heights[1:] >= 0.0))[0]
    return times[k] - heights[k] * (times[k + 1] - times[k]) / (heights[k + 1] - heights[k])


def heaving_water(half: float, draft: float, depth: float, width: float, h: float = 0.01) -> float:
    """The mass of water that goes along with a box, ``half`` of which is so wide, that heaves in the middle of a tank,
    by potential flow on cells of the size h: the surfaces beside the box move as pistons, by as much water as it moves
    aside."""
    from scipy.sparse import lil_matrix
    from scipy.sparse.linalg import spsolve

    columns, rows, under, below = (round(length / h) for length in (0.5 * width, depth, half, depth - draft))
    numbers = -np.ones((columns, rows), dtype=int)
    wet = np.ones((columns, rows), dtype=bool)
    wet[:under, below:] = False
    numbers[wet] = np.arange(wet.sum())
    flows, matrix = np.zeros(wet.sum()), lil_matrix((wet.sum(), wet.sum()))
    for i, j in np.argwhere(wet):
        k = numbers[i, j]
        for a, b in ((i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1)):
            if 0 <= a < columns and 0 <= b < rows and wet[a, b]:
                matrix[k, k] -= 1.0
                matrix[k, numbers[a, b]] += 1.0
            elif b > j:
                flows[k] = -h * (1.0 if i < under else -half / (0.5 * width - half))
    wanted = flows.copy()
    matrix[0], wanted[0] = 0.0, 0.0
    matrix[0, 0] = 1.0
    return 2.0 * 1000.0 * float(-(flows * spsolve(matrix.tocsr(), wanted)).sum())


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
