"""Do solids that move, and meshes, hold water? Each function returns what it found."""

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from cortado import Scene, Simulation
from cortado.discretise.solid import rotation_matrix
from cortado.scene.solid_shapes import BoxSolid, CupSolid, MeshSolid
from cortado.scene.solids import SolidTable
from scenes import box

WATER = {"name": "water", "rest_density": 1000.0, "viscosity": 0.001}
GRAVITY = 9.81
MESHES = ("torus", "cup with a handle", "bodies that overlap", "box as a tank", "200,000 triangles")
MESHES += ("a torus that crosses itself",)


def simulated(
    dimension: int, spacing: float, step: float, steps: int, every: int, precision: str = "float32", **tables: Any
) -> Any:
    """The trajectory of a scene of water; a particle that enters a solid or leaves the container ends the run."""
    own = {"phase": [WATER], "discretisation": {"spacing": spacing}}
    own["solver"] = {"kind": "projection", "time_step": step}
    scene = Scene(dimension=dimension, **{**own, **tables})
    return Simulation(scene, precision=precision).run(steps, record_every=every)


def in_frame(run: Any, name: str, frame: int) -> np.ndarray:
    """(n, 2) where particles are in the frame of a solid in the plane [m], about its middle."""
    turn = rotation_matrix((float(run.solids[name].rotations[frame]),))
    return np.asarray((run.positions[frame].astype(np.float64) - run.solids[name].positions[frame]) @ turn)


def deepest(run: Any, solid: SolidTable) -> float:
    """How deep particles are in a solid of a scene in the plane at most [m]."""
    own, frames = solid.own_solid(), range(len(run.positions))
    return float(max(-own.distance(in_frame(run, solid.name, frame)).min() for frame in frames))


def stirred(across: int, steps: int, thickness: float = 0.08, precision: str = "float32") -> dict[str, float]:
    """A square of water, so many particles wide, with a paddle in it, of a thickness [m], that turns about its middle
    and whose tips move at 1 m/s: the greatest depth of a particle in the paddle, and outside of the tank, in
    spacings."""
    spacing, half = 1.0 / across, np.array([0.25, 0.5 * thickness])
    middle = np.array([0.5, 0.45])
    paddle = box(list(middle - half), list(middle + half), name="paddle", motion="path")
    paddle["angular_velocity"] = float(1.0 / np.linalg.norm(half))
    run = simulated(
        *(2, spacing, 0.045 * spacing, steps, 20, precision),
        fluid=[box([0.0, 0.0], [1.0, 1.0], phase="water")],
        container=box([0.0, 0.0], [1.0, 1.5]),
        solid=[paddle],
    )
    outside = float(np.maximum(-run.positions, run.positions - [1.0, 1.5]).max())
    return {
        "particles": run.positions.shape[1],
        "turns": float(run.solids["paddle"].rotations[-1]) / (2.0 * np.pi),
        "deepest": deepest(run, BoxSolid(**paddle)) / spacing,
        "outside": max(outside, 0.0) / spacing,
    }


def cup_turned(across: int, steps: int) -> dict[str, float]:
    """A cup, so many particles wide, is turned upside down above a floor and back: how many particles went through its
    wall, how many were poured over its rim, and the greatest depth of one in it, in spacings."""
    spacing, radius, height, thickness = 1.0 / across, 0.5, 1.2, 5.0 / across
    step = 0.03 * spacing
    time = step * steps
    base = np.array([0.0, 1.0])
    cup = {"name": "cup", "shape": "cup", "base": list(base), "radius": radius, "height": height, "motion": "path"}
    cup |= {"thickness": thickness, "times": [0.0, 0.45 * time, 0.55 * time, time]}
    cup["rotations"] = [0.0, np.pi, np.pi, 0.0]
    bottom = base[1] + thickness
    run = simulated(
        *(2, spacing, step, steps, 4),
        fluid=[box([-radius, bottom], [radius, bottom + 0.8], phase="water")],
        container=box([-4.0, -0.6], [4.0, 4.0]),
        solid=[cup],
    )
    middle = float(run.solids["cup"].positions[0][1] - base[1])
    floor, rim = thickness - middle, height - middle
    held, through, poured = np.ones(run.positions.shape[1], dtype=bool), 0, 0
    for frame in range(len(run.positions)):
        x = in_frame(run, "cup", frame)
        above = x[:, 1] >= rim
        beneath = ((np.abs(x[:, 0]) > radius + 0.5 * thickness) | (x[:, 1] < floor - 0.5 * thickness)) & ~above
        through, poured = through + int((held & beneath).sum()), poured + int((held & above).sum())
        held &= ~beneath & ~above
    return {
        "particles": len(held),
        "poured": poured,
        "through its wall": through,
        "still in it": int(held.sum()),
        "deepest": deepest(run, CupSolid(**cup)) / spacing,
    }


def meshes(steps: int, name: str, bottom: bool = True, **options: Any) -> dict[str, float]:
    """Water falls onto a mesh of `MESHES`, or is in it: the greatest energy over the first, which is that above the
    floor, and the greatest depth of a particle in the mesh, in spacings; without the ``bottom`` of the cup to see that
    it is this that holds water."""
    mesh, tables = _meshes(bottom)[name]
    with tempfile.TemporaryDirectory() as folder:
        file = str(Path(folder) / "mesh.stl")
        mesh.export(file)
        solid = {"name": "mesh", "shape": "mesh", "file": file, **tables.pop("mesh", {})}
        run = simulated(3, 0.05, 0.002, steps, 25, solid=[solid], **tables, **options)
        body = MeshSolid(**solid).solid()
        furthest = max(-body.distance_up_to(x.astype(np.float64), 0.1).min() for x in run.positions)
    heights = run.positions[:, :, 1].astype(np.float64)
    energies = GRAVITY * heights.mean(axis=1) + 0.5 * (run.velocities**2).sum(axis=2).mean(axis=1)
    return {
        "particles": run.positions.shape[1],
        "energy": float(energies.max() / energies[0]),
        "deepest": float(furthest) / 0.05,
        "lowest": float(heights.min()),
    }


def _meshes(bottom: bool) -> dict[str, tuple[trimesh.Trimesh, dict[str, Any]]]:
    """What `MESHES` names; y is upwards."""
    torus = trimesh.creation.torus(0.2, 0.09, major_sections=60, minor_sections=30)
    fine = trimesh.creation.torus(0.2, 0.09, major_sections=400, minor_sections=250)
    side = [[0.3, 0.0], [0.3, 0.5], [0.22, 0.5]]
    profile = [[0.0, 0.0], *side, [0.22, 0.1], [0.0, 0.1]] if bottom else [*side, [0.22, 0.0], [0.3, 0.0]]
    bars = [trimesh.creation.box(bounds=[[0.26, -0.06, z], [0.5, 0.06, z + 0.11]]) for z in (0.08, 0.34)]
    grip = trimesh.creation.box(bounds=[[0.42, -0.06, 0.08], [0.53, 0.06, 0.45]])
    cup = trimesh.util.concatenate([trimesh.creation.revolve(profile, sections=48), *bars, grip])
    boxes = [([-0.25, -0.1, -0.1], [0.1, 0.1, 0.1]), ([0.0, -0.2, -0.15], [0.2, 0.15, 0.05])]
    overlapping = trimesh.util.concatenate([trimesh.creation.box(bounds=ends) for ends in boxes])
    upright = trimesh.transformations.rotation_matrix(-0.5 * np.pi, [1.0, 0.0, 0.0])
    spindle = trimesh.creation.torus(0.1, 0.15, major_sections=60, minor_sections=40)  # goes around its middle twice
    for mesh in (torus, fine, cup, spindle):
        mesh.apply_transform(upright)
    tank = trimesh.creation.box(bounds=[[0.0, 0.0, 0.0], [0.6, 0.5, 0.4]])
    container = box([-0.35, 0.0, -0.35], [0.35, 0.8, 0.35])
    block = box([-0.35, 0.3, -0.35], [0.35, 0.5, 0.35], phase="water")
    around = {"fluid": [block], "container": container, "mesh": {"position": [0.0, 0.25, 0.0]}}
    poured = {"shape": "cylinder", "base": [0.0, 0.1, 0.0], "radius": 0.22, "height": 0.3, "phase": "water"}
    in_tank = box([0.0, 0.0, 0.0], [0.3, 0.4, 0.4], phase="water")
    return {
        "torus": (torus, dict(around)),
        "200,000 triangles": (fine, dict(around)),
        "a torus that crosses itself": (spindle, {**around, "mesh": {"position": [0.0, 0.3, 0.0]}}),
        "bodies that overlap": (overlapping, {**around, "mesh": {"position": [0.0, 0.3, 0.0]}}),
        "cup with a handle": (cup, {"fluid": [poured]}),
        "box as a tank": (tank, {"fluid": [in_tank], "mesh": {"side": "inside"}}),
    }
