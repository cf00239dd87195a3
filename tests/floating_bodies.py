"""How deep does a body float, and how much water goes along with one that gets faster?"""

from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from scipy.optimize import brentq
from scipy.special import j1, jvp, y1, yvp

from cortado import Scene, Simulation
from cortado.sensors import BodyMotion
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
    draft = float(drafts[len(drafts) // 2 :].mean() / wanted)
    return {"particles": len(simulation.positions), "draft over the exact one": draft}


def rings(file: str, inner: float, outer: float, spacing: float) -> None:
    """Write particles in rings between two radii about 0."""
    radii = np.arange(inner + 0.5 * spacing, outer, spacing)
    angles = [2.0 * np.pi * (np.arange(n) + 0.3 * n) / n for n in np.round(2.0 * np.pi * radii / spacing)]
    made = [r * np.stack([np.cos(angle), np.sin(angle)], axis=1) for r, angle in zip(radii, angles, strict=True)]
    np.save(file, np.concatenate(made))


def round_tank(file: str, spacing: float, fluid: dict[str, Any], disc: dict[str, Any], **tables: Any) -> Simulation:
    """A tank of a radius of 0.45 m, full of fluid from a ``file``, with a free disc of 0.15 m in its middle."""
    rings(file, 0.15, 0.45, spacing)
    shape = {"shape": "sphere", "centre": [0.0, 0.0], "slip": disc.get("slip", "free")}
    scene = Scene(
        dimension=2,
        discretisation={"spacing": spacing},
        phase=[{"name": "fluid", "rest_density": 1000.0, **fluid}],
        fluid=[{"shape": "points", "file": file, "phase": "fluid"}],
        container={"shape": "none"},
        solid=[
            {"name": "tank", **shape, "radius": 0.45, "side": "inside"},
            {"name": "disc", **shape, "radius": 0.15, "motion": "free", **disc},
        ],
        **tables,
    )
    return Simulation(scene, precision="float64")


def disc_in_a_round_tank(
    density: float, file: str, spacing: float, steps: int, freedom: Any = None, **solver: Any
) -> np.ndarray:
    """How much faster a disc of the radius a = 0.15 m gets in each step, in the middle of a round tank of the radius
    b = 0.45 m that is full of water in rings, which a ``file`` takes on: over g (rho_0 - rho) / (rho + C rho_0) with
    the added mass C = (b^2 + a^2) / (b^2 - a^2) of theory."""
    inner, outer = 0.15, 0.45
    disc, own = {"density": density, "freedom": freedom}, {"kind": "projection", "time_step": STEP, **solver}
    simulation = round_tank(file, spacing, {"viscosity": 0.001}, disc, solver=own)
    faster = np.diff(simulation.run(steps, record_every=1).solids["disc"].velocities[:, 1])
    part = (outer**2 + inner**2) / (outer**2 - inner**2)
    found: np.ndarray = faster / (9.81 * STEP * (1000.0 - density) / (density + 1000.0 * part))
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
        disc = {"slip": "no", "density": density, "angular_velocity": 1.0}
        tables = {"forces": {"gravity": [0.0, 0.0]}, "solver": {"kind": "projection", "time_step": step}}
        file, spacing = f"{folder}/rings.npy", 2.0 * inner / across
        simulation = round_tank(file, spacing, {"viscosity": viscosity}, disc, **tables)
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
    room = box([0.0, 0.0], [wide, high + 4.0 * spacing], slip="no")
    solver, disc = {"kind": "projection", "time_step": step}, {**disc, "motion": "free", "density": density}
    scene = pool([wide, high], [wide, high], spacing, viscosity, container=room, solid=[disc], solver=solver)
    k = 2.0 * radius / wide
    part = -np.log(k) - 0.9157 + 1.7244 * k**2 - 1.7302 * k**4 + 2.4056 * k**6 - 4.5913 * k**8
    return sinking(scene, (density - 1000.0) * 9.81 * radius**2 * part / (4.0 * viscosity), duration, device)


def sinking(
    scene: Scene, exact: float, duration: float, device: str, settling: float | None = None
) -> dict[str, float]:
    """How fast the free body of a scene, 0.1 m across in syrup of 0.1 m2/s, sinks in the last quarter of a run, over an
    ``exact`` speed [m/s], and by how much of that it swings about its course. Before that the body is as heavy as the
    syrup, for ``settling`` [s] in steps four times as long, or as long as the run: where a surface cuts the lattice
    there is room, and particles of syrup fill it slowly."""
    name, density = next((solid.name, solid.density) for solid in scene.solid if solid.motion == "free")
    simulation, steps = Simulation(scene, device, precision="float64"), round(duration / scene.solver.time_step)
    step = scene.solver.time_step if settling is None else 4.0 * scene.solver.time_step
    first = steps if settling is None else round(settling / step)
    settled = simulation.run(first, {f"{name}.density": 1000.0, "time_step": step}, record_every=first)
    options = {"state": settled.last_state, "record_every": steps, "sensors": {"body": BodyMotion(name)}}
    run = simulation.run(steps, {f"{name}.density": density}, **options)
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
