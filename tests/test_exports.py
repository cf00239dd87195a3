"""Runs as files of other programs, read again by the libraries of these: VTK, OpenUSD, trimesh, xarray."""

import re
import sys
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import trimesh

import cortado
from cortado import ComputationError, InputError, Trajectory
from cortado.pictures import export_formats as formats
from cortado.pictures import exported
from cortado.pictures.export_formats import FORMATS
from cortado.pictures.exported import Exported, WholeFrames
from cortado.pictures.film import ShownRun
from cortado.pictures.painter import Scale
from cortado.runs.frames import Marks, SolidMotion, SolidMotions
from cortado.runs.run_folder import RunFolder
from cortado.scene.scene import scene_from_dict
from full_disk import largest_file
from scenes import box, pool

SPACING = 0.05
PHASES = [
    {"name": "water", "rest_density": 1000.0, "viscosity": 0.1, "colour": [0.1, 0.3, 0.8]},
    {"name": "oil", "rest_density": 900.0, "viscosity": 0.1, "colour": [0.9, 0.7, 0.1]},
]
ROTOR = {"name": "my rotor", "shape": "box", "lower": [0.5, 0.0, 0.0], "upper": [0.6, 0.3, 0.2], "motion": "path"}
STONE = {"name": "stone", "shape": "sphere", "centre": [0.8, 0.1, 0.1], "radius": 0.06, "colour": [0.5, 0.2, 0.2]}


@cache
def scene():
    """Two fluids beside a box that turns and a ball at rest."""
    return pool(
        **{"upper": [0.4, 0.2, 0.2], "room": [1.0, 0.6, 0.2], "spacing": SPACING, "name": "two", "phase": PHASES},
        fluid=[box([x, 0.0, 0.0], [x + 0.2, 0.2, 0.2], phase=name) for x, name in ((0.0, "water"), (0.2, "oil"))],
        solid=[{**ROTOR, "velocity": [0.1, 0.0, 0.0], "angular_velocity": [0.0, 1.0, 0.0]}, STONE],
        forces={"gravity": [0.0, -9.81, 0.0]},
    )


def lattice():
    axes = [(np.arange(count) + 0.5) * SPACING for count in (8, 4, 4)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3).astype(np.float32)


@cache
def trajectory():
    """Made by hand: the fluid rises by 0.1 m a second, the box goes along x and turns about y."""
    first, times = lattice(), np.array([0.0, 0.5, 1.0])
    positions = first + (0.1 * times[:, None, None] * [0.0, 1.0, 0.0]).astype(np.float32)
    is_oil = (first[:, 0] > 0.2).astype(np.float32)
    fractions = np.tile(np.stack([1.0 - is_oil, is_oil], axis=1), (3, 1, 1))
    turns = np.array([[0.0, angle, 0.0] for angle in (0.0, 2.0, 4.0)])
    motion = SolidMotion(np.array([[0.55, 0.15, 0.1], [0.6, 0.15, 0.1], [0.65, 0.15, 0.1]]), turns)
    velocities = np.broadcast_to(np.float32([0.0, 0.1, 0.0]), positions.shape)
    return Trajectory(
        times=times,
        steps=np.array([0, 500, 1000]),
        positions=positions,
        velocities=velocities,
        diagnostics={"converged": np.ones(1000, dtype=bool)},
        mass_fractions=fractions,
        quantities={"density": np.full(positions.shape[:2], 950.0, np.float32)},
        solids=SolidMotions({"my rotor": motion}),
        scene=scene(),
    )


def box_corners(angle, position):
    half = 0.5 * (np.array(ROTOR["upper"]) - ROTOR["lower"])
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * half
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    return corners @ turn.T + position


def same_points(found, wanted):
    """Whether two clouds are the same, points that come twice once."""
    one, other = (np.unique(np.round(np.asarray(a, dtype=float), 5) + 0.0, axis=0) for a in (found, wanted))
    return one.shape == other.shape and np.allclose(one, other, atol=2e-5)


# ---- for USD -----------------------------------------------------------------------------------------------------
def test_usd_has_all_of_it_over_time(tmp_path):
    usd, geometry = pytest.importorskip("pxr.Usd"), pytest.importorskip("pxr.UsdGeom")
    path = trajectory().export(tmp_path / "usd", to="usd")
    assert [one.name for one in path.parent.iterdir()] == ["run.usdc"]
    stage = usd.Stage.Open(str(path))
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode(), stage.GetTimeCodesPerSecond()) == (0.0, 2.0, 2.0)
    assert geometry.GetStageMetersPerUnit(stage) == 1.0 and geometry.GetStageUpAxis(stage) == "Y"
    assert stage.GetDefaultPrim().GetPath() == "/run"
    particles = geometry.Points.Get(stage, "/run/particles")
    assert particles.GetPointsAttr().GetTimeSamples() == [0.0, 1.0, 2.0]
    for code in range(3):
        np.testing.assert_array_equal(particles.GetPointsAttr().Get(code), trajectory().positions[code])
    np.testing.assert_array_equal(particles.GetVelocitiesAttr().Get(1), trajectory().velocities[1])
    np.testing.assert_allclose(particles.GetWidthsAttr().Get(), [SPACING])
    fields = geometry.PrimvarsAPI(particles)
    np.testing.assert_array_equal(fields.GetPrimvar("density").Get(2), np.full(128, 950.0))
    np.testing.assert_array_equal(fields.GetPrimvar("mass_fraction_1").Get(0), trajectory().mass_fractions[0, :, 1])
    colours = np.array(particles.GetDisplayColorAttr().Get(1))
    np.testing.assert_allclose(np.unique(colours, axis=0), [PHASES[0]["colour"], PHASES[1]["colour"]], rtol=1e-6)


def test_colours_are_those_of_the_scale_that_pictures_have(tmp_path):
    """Blue where particles are slow, yellow where they are fast, in every frame alike."""
    run = trajectory()
    speeds = np.linspace(0.0, 1.0, run.particles)[None, :, None] * [[[0.0, 1.0, 0.0]]]
    run = replace(run, velocities=np.broadcast_to(speeds, run.positions.shape).astype(np.float32))
    by_speed = run.scene.replaced('picture={colour = "speed"}')
    run.export(tmp_path / "glb", "glb", by_speed)
    cloud = trimesh.load(tmp_path / "glb/frame_00001.glb").geometry["particles"]
    wanted = Scale.of("speed", np.linalg.norm(run.velocities, axis=2)).colours(speeds[0, :, 1])
    np.testing.assert_allclose(cloud.colors[:, :3] / 255.0, wanted, atol=0.02)  # a step of the palette
    assert wanted[-1, 0] > 0.9 and wanted[0, 0] < 0.1
    with pytest.raises(InputError, match="pressure was not recorded"):
        run.export(tmp_path / "none", "glb", run.scene.replaced('picture={colour = "pressure"}'))
    assert not (tmp_path / "none").exists()


def test_usd_has_a_surface_that_encloses_the_fluid_and_solids_in_motion(tmp_path):
    usd, geometry = pytest.importorskip("pxr.Usd"), pytest.importorskip("pxr.UsdGeom")
    stage = usd.Stage.Open(str(trajectory().export(tmp_path, to="usd")))
    surface = geometry.Mesh.Get(stage, "/run/surface")
    for code in range(3):
        corners = np.array(surface.GetFaceVertexIndicesAttr().Get(code)).reshape(-1, 3)
        mesh = trimesh.Trimesh(np.array(surface.GetPointsAttr().Get(code)), corners, process=False)
        assert mesh.is_watertight  # with rounded edges, and flat where the fluid touches walls
        assert mesh.volume == pytest.approx(0.2**2 * 0.4, rel=0.01)
        assert mesh.bounds[:, 2].tolist() == pytest.approx([0.0, 0.2])
        assert mesh.center_mass[1] == pytest.approx(0.1 + 0.05 * code, abs=0.01)
        np.testing.assert_allclose(surface.GetVelocitiesAttr().Get(code)[0], [0.0, 0.1, 0.0], atol=1e-6)
        assert set(surface.GetFaceVertexCountsAttr().Get(code)) == {3}
    rotor, time = geometry.Xform.Get(stage, "/run/solid_my_rotor"), [0.0, 1.0, 2.0]
    assert [list(op.GetTimeSamples()) for op in rotor.GetOrderedXformOps()] == [time, time]
    own = np.array(geometry.Mesh.Get(stage, "/run/solid_my_rotor/mesh").GetPointsAttr().Get())
    for code, angle in enumerate((0.0, 2.0, 4.0)):
        matrix = np.array(rotor.ComputeLocalToWorldTransform(code))  # for rows
        wanted = box_corners(angle, [0.55 + 0.05 * code, 0.15, 0.1])
        assert same_points(np.c_[own, np.ones(len(own))] @ matrix[:, :3], wanted)
    between = np.array(rotor.ComputeLocalToWorldTransform(1.5))  # the short way, at 3 rad
    assert same_points(np.c_[own, np.ones(len(own))] @ between[:, :3], box_corners(3.0, [0.625, 0.15, 0.1]))
    stone = geometry.Xform.Get(stage, "/run/solid_stone")
    assert not any(op.GetTimeSamples() for op in stone.GetOrderedXformOps())
    extent = geometry.Mesh.Get(stage, "/run/solid_stone/mesh").GetExtentAttr().Get()
    np.testing.assert_allclose(extent, [[-0.06] * 3, [0.06] * 3], atol=1e-3)


def test_whole_frames_are_as_many_in_a_second_as_were_asked_for():
    for times, rate, count, left_out in [
        (0.1 * np.arange(11) + 3.0, 10.0, 11, 0.0),
        (np.array([*0.04 * np.arange(26), 1.01]), 25.0, 26, 0.01),  # the last state comes early
        (0.021 * np.arange(101), 1.0 / 0.021, 101, 0.0),  # every ten steps of 2.1 ms
        (np.ceil(0.04 * np.arange(51) / 0.003) * 0.003, 25.0, 51, 0.001),  # the first step at 25 a second or after it
        (np.array([0.2]), 24.0, 1, 0.0),
    ]:
        found = WholeFrames.of(times)
        assert found.rate == pytest.approx(rate) and len(found.times) == count
        assert found.left_out == pytest.approx(left_out, abs=1e-9)
        np.testing.assert_allclose(found.times, times[0] + np.arange(count) / rate)
        np.testing.assert_allclose(times[found.recorded] + found.shifts, found.times)
        assert len(set(found.recorded)) == count  # no state twice, none left out


def recorded(step, marks, last):
    """(frames,) [s] the first states at marks or after them, of a run with steps [s] that ends at the last state."""
    times = np.append(step * np.arange(round(last / step)), last)
    due = marks.passed(times)
    return times[(np.diff(due, prepend=due[0] - 1) > 0) | (times == last)]


@pytest.mark.parametrize(
    ("rate", "step", "every"),
    [(29.97, 0.0021, 1), (24.0, 0.1, 1), (60.0, 0.0021, 3)],
    ids=["NTSC", "steps longer than frames", "every third"],
)
def test_usd_has_the_rate_that_was_asked_for(tmp_path, rate, step, every):
    """At each code all is where it should be: fluid rises evenly, one solid goes there and back, another turns."""
    usd, geometry = pytest.importorskip("pxr.Usd"), pytest.importorskip("pxr.UsdGeom")
    knots, way = [0.0, 0.35, 0.8, 1.1], [0.55, 0.9, 0.4, 0.4]
    solids = [
        {**ROTOR, "motion": "path", "times": knots, "positions": [[x, 0.15, 0.1] for x in way]},
        {**ROTOR, "name": "fan", "motion": "path", "angular_velocity": [0.0, 0.0, 25.0]},
    ]
    marks, of = Marks(0.0, rate), scene_from_dict({**scene().model_dump(exclude_none=True), "solid": solids})
    times, first = recorded(step, marks, 0.5), lattice()
    there = np.stack([np.interp(times, knots, way), *np.outer([0.15, 0.1], np.ones(len(times)))], axis=1)
    still, turns = np.tile([0.55, 0.15, 0.1], (len(times), 1)), np.outer(times, [0.0, 0.0, 25.0])
    motions = {"my rotor": SolidMotion(there, 0.0 * turns), "fan": SolidMotion(still, turns)}
    run = risen(times, np.rint(times / step).astype(int), motions, marks=marks)
    stage = usd.Stage.Open(str(run[::every].export(tmp_path / "usd", to="usd", scene=of)))
    assert stage.GetTimeCodesPerSecond() == stage.GetFramesPerSecond() == pytest.approx(rate / every, rel=1e-15)
    points = geometry.Points.Get(stage, "/run/particles").GetPointsAttr()
    codes = np.arange(np.floor(0.5 * rate / every + 1e-9) + 1)
    assert points.GetTimeSamples() == codes.tolist()
    for code in codes:
        time = code * every / rate
        np.testing.assert_allclose(points.Get(code)[0], first[0] + [0.0, 0.1 * time, 0.0], atol=1e-6)
        place, turn = (
            np.array(geometry.Xform.Get(stage, f"/run/solid_{name}").ComputeLocalToWorldTransform(code))
            for name in ("my_rotor", "fan")
        )
        assert place[3, 0] == pytest.approx(np.interp(time, knots, way), abs=1e-9)
        np.testing.assert_allclose(turn[0, :2], [np.cos(25.0 * time), np.sin(25.0 * time)], atol=1e-6)


@pytest.mark.parametrize("spin", [np.array(3.0), np.array([0.0, 3.0, 0.0])])
def test_a_free_body_goes_on_at_its_velocities(spin):
    """Recorded late on an even way, it is at each mark where it was then."""
    d, marks = 2 if spin.ndim == 0 else 3, Marks(0.0, 30.0)
    times = recorded(0.007, marks, 0.5)
    velocity, spins = np.arange(1.0, d + 1.0), np.multiply.outer(np.ones(len(times)), spin)
    motion = SolidMotion(np.outer(times, velocity), (times * spins.T).T, np.outer(np.ones(len(times)), velocity), spins)
    whole = WholeFrames.of(times, marks)
    found = SolidMotions({"raft": motion}).at(scene(), times, whole.recorded, whole.times)["raft"]
    np.testing.assert_allclose(found.positions, np.outer(whole.times, velocity), atol=1e-12)
    np.testing.assert_allclose(found.rotations, np.multiply.outer(whole.times, spin), atol=1e-12)
    assert np.abs(whole.shifts).max() > 0.004


def test_files_and_parts_of_a_run_know_its_rate(tmp_path):
    marks = Marks(0.0, 2.0)
    run = replace(trajectory(), marks=marks)
    run.save(tmp_path / "run.vtkhdf")
    assert Trajectory.load(tmp_path / "run.vtkhdf").marks == marks
    trajectory().save(tmp_path / "none.vtkhdf")
    assert Trajectory.load(tmp_path / "none.vtkhdf").marks is None
    assert run[::2].marks == Marks(0.0, 1.0) and run[1:].marks == Marks(0.5, 2.0) and run[::-1].marks is None
    path = replace(run, times=np.array([0.0, 0.51, 1.1])).export(tmp_path / "vtp", to="vtp")
    assert {float(time) for time in re.findall(r'timestep="([^"]+)"', path.read_text())} == {0.0, 0.5, 1.0}


def test_frames_are_due_at_marks_and_steps_that_grow_are_shown_at_even_times():
    for start in (0.0, 0.123):
        marks = Marks(start, 25.0)
        times = start + np.array([0.0, 0.0401, 0.08 - 1e-12, 0.1237, 0.13])
        assert marks.passed(times).tolist() == [0, 1, 2, 3, 3]
        np.testing.assert_allclose(marks.due(times) - start, [0.0, 0.04, 0.08, 0.12, 0.13], atol=1e-12)
        sparse = start + 0.1 * np.arange(5)
        np.testing.assert_array_equal(marks.due(sparse), sparse)
    times = np.cumsum(np.linspace(0.002, 0.02, 200))
    found = WholeFrames.of(times)
    np.testing.assert_allclose(np.diff(found.times), 1.0 / found.rate)
    np.testing.assert_allclose(times[found.recorded] + found.shifts, found.times)
    assert np.abs(found.shifts).max() <= 0.5 * np.diff(times).max() + 1e-12
    assert "along their velocities" in found.in_words


def risen(times, steps, motions, **more):
    first, count = lattice(), len(times)
    return replace(
        trajectory(),
        times=times,
        steps=steps,
        positions=np.array([first + [0.0, 0.1 * t, 0.0] for t in times]),
        velocities=np.broadcast_to([0.0, 0.1, 0.0], (count, *first.shape)),
        mass_fractions=np.tile(trajectory().mass_fractions[:1], (count, 1, 1)),
        quantities={},
        solids=SolidMotions(motions),
        **more,
    )


def test_fluid_that_waits_in_an_emitter_is_not_exported(tmp_path, capsys):
    nozzle = {"phase": "water", "outlet": [0.0, 0.4, 0.1], "direction": [1.0, 0.0, 0.0], "radius": 0.08, "length": 0.5}
    made = {**scene().model_dump(exclude_none=True), "solid": [], "emitter": [{**nozzle, "flow_rate": 0.02}]}
    made = scene_from_dict({**made, "fluid": made["fluid"][:1], "phase": PHASES[:1]})
    sample, still = made.emitter[0].sample(SPACING), lattice()[:64]
    emitted = np.array([[0.0], [0.21], [0.52]])
    flown = sample.positions + emitted[..., None] * np.array([1.0, 0.0, 0.0])
    positions = np.concatenate([np.tile(still, (3, 1, 1)), flown], axis=1).astype(np.float32)
    run = Trajectory(
        times=np.array([0.0, 0.1, 0.2]),
        steps=np.arange(3),
        positions=positions,
        velocities=np.zeros_like(positions),
        diagnostics={"converged": np.ones(2, dtype=bool)},
        others={"nozzle.emitted": emitted, "nozzle.outlet": np.tile(np.array(nozzle["outlet"]), (3, 1, 1))},
    )
    run.export(tmp_path / "ply", to="ply", scene=made)
    for k in range(3):
        count = 64 + np.count_nonzero(sample.upstream <= emitted[k])
        points = trimesh.load(tmp_path / f"ply/particles_0000{k}.ply").vertices
        assert len(points) == count and points[:, 0].min() > 0.0
        surface = trimesh.load(tmp_path / f"ply/surface_0000{k}.ply", process=False)
        assert surface.volume == pytest.approx(count * SPACING**3, rel=0.01)
    assert "encloses" not in capsys.readouterr().out


def test_a_surface_that_does_not_enclose_the_fluid_is_told(tmp_path, capsys, monkeypatch):
    trajectory()[2:].export(tmp_path / "held", to="ply")
    assert "encloses" not in capsys.readouterr().out
    monkeypatch.setattr(exported, "MOST_SHIFT", 0.0)
    trajectory()[2:].export(tmp_path / "cut", to="ply")
    told = re.search(r"cut: at 1 s the surface encloses (\S+) m³, where there are 0.016 m³", capsys.readouterr().out)
    mesh = trimesh.load(tmp_path / "cut/surface_00000.ply", process=False)
    assert told and float(told[1]) == pytest.approx(mesh.volume, rel=1e-3)


# ---- for series --------------------------------------------------------------------------------------------------
def test_paraview_reads_times_parts_and_fields(tmp_path):
    vtk, support = pytest.importorskip("vtkmodules.vtkIOXML"), pytest.importorskip("vtkmodules.util.numpy_support")
    path = trajectory().export(tmp_path, to="vtp")
    entries = re.findall(r'timestep="([^"]+)" part="(\d)" name="(\w+)" file="([^"]+)"', path.read_text())
    assert sorted({float(time) for time, *_ in entries}) == [0.0, 0.5, 1.0] and len(entries) == 12
    assert {name for _, _, name, _ in entries} == {"particles", "surface", "solid_my_rotor", "solid_stone"}

    def read(name, time):
        (file,) = [file for when, _, part, file in entries if (part, float(when)) == (name, time)]
        reader = vtk.vtkXMLPolyDataReader()
        reader.SetFileName(str(tmp_path / file))
        reader.Update()
        data = reader.GetOutput()
        fields = data.GetPointData()
        found = {
            fields.GetArrayName(k): support.vtk_to_numpy(fields.GetArray(k)) for k in range(fields.GetNumberOfArrays())
        }
        return data, support.vtk_to_numpy(data.GetPoints().GetData()), found

    data, points, fields = read("particles", 0.5)
    np.testing.assert_array_equal(points, trajectory().positions[1])
    assert data.GetNumberOfVerts() == 128 and {"velocity", "colour", "density", "mass_fraction_0"} <= fields.keys()
    np.testing.assert_array_equal(fields["velocity"], trajectory().velocities[1])
    data, _, fields = read("surface", 1.0)
    assert data.GetNumberOfPolys() > 100 and fields["colour"].dtype == np.uint8
    np.testing.assert_allclose(np.linalg.norm(fields["normals"], axis=1), 1.0, rtol=1e-4)
    assert same_points(read("solid_my_rotor", 1.0)[1], box_corners(4.0, [0.65, 0.15, 0.1]))
    assert [file for _, _, name, file in entries if name == "solid_stone"] == ["solid_stone.vtp"] * 3


@pytest.mark.parametrize("ending", ["ply", "obj"])
def test_series_have_a_file_for_each_part_that_changes(ending, tmp_path):
    assert trajectory()[:2].export(tmp_path, to=ending) == tmp_path
    names = {f"{part}_0000{k}.{ending}" for part in ("particles", "surface", "solid_my_rotor") for k in range(2)}
    assert {one.name for one in tmp_path.iterdir()} == names | {f"solid_stone.{ending}"}
    rotor = trimesh.load_mesh(tmp_path / f"solid_my_rotor_00001.{ending}", process=False)
    assert same_points(rotor.vertices, box_corners(2.0, [0.6, 0.15, 0.1])) and rotor.volume > 0.0
    surface = trimesh.load_mesh(tmp_path / f"surface_00000.{ending}", process=False)
    right = surface.vertices[:, 0] > 0.3  # of oil; bytes are those of sRGB
    assert np.median(surface.visual.vertex_colors[right][:, :3], axis=0) == pytest.approx([243, 218, 89], abs=2)
    if ending == "ply":
        points = trimesh.load(tmp_path / "particles_00001.ply").vertices
        np.testing.assert_allclose(points, trajectory().positions[1], rtol=1e-6)


def test_gltf_has_everything_by_name_and_y_up(tmp_path):
    on_side = scene().replaced("forces.gravity=[0.0, 0.0, -9.81]")  # z is up
    trajectory()[:2].export(tmp_path, to="glb", scene=on_side)
    assert sorted(one.name for one in tmp_path.iterdir()) == ["frame_00000.glb", "frame_00001.glb"]
    found = trimesh.load(tmp_path / "frame_00001.glb")
    assert set(found.geometry) == {"surface", "particles", "solid_my_rotor", "solid_stone"}
    placed = {name: found.graph.get(name)[0] for name in found.geometry}
    points = trimesh.transform_points(found.geometry["particles"].vertices, placed["particles"])
    np.testing.assert_allclose(points[:, [2, 0, 1]], trajectory().positions[1], atol=1e-6)
    corners = trimesh.transform_points(found.geometry["solid_my_rotor"].vertices, placed["solid_my_rotor"])
    assert same_points(corners[:, [2, 0, 1]], box_corners(2.0, [0.6, 0.15, 0.1]))


def flat():
    block = box([0.5, 0.0], [0.7, 0.2], name="block")
    solver = {"kind": "pcisph", "time_step": 0.001}
    found = pool([0.2, 0.2], [1.0, 1.0], 0.1, 0.1, name="flat", solid=[block], solver=solver)
    still, steps = np.tile([[0.05, 0.05], [0.15, 0.05]], (3, 1, 1)), np.arange(3)
    return Trajectory(0.1 * steps, steps, still, 0.0 * still, {"converged": np.ones(2, bool)}, scene=found)


def test_the_plane_has_points_and_outlines(tmp_path):
    made = flat()[:1]
    made.export(tmp_path, to="ply")
    assert {one.name for one in tmp_path.iterdir()} == {"particles_00000.ply", "solid_block.ply"}
    block = trimesh.load_mesh(tmp_path / "solid_block.ply", process=False)
    np.testing.assert_allclose(block.bounds, [[0.5, 0.0, -0.01], [0.7, 0.2, 0.01]], atol=1e-6)
    away = block.triangles_center - [0.6, 0.1, 0.0]
    assert ((block.face_normals * away).sum(axis=1) > 0.0).all()
    assert made.to_xarray().sizes == {"time": 1, "particle": 2, "space": 2}


def test_the_command_line_writes_every_other_frame_of_a_run(tmp_path, cortado_command):
    folder = RunFolder.create(tmp_path / "run", flat().scene.to_json(), ["cortado", "run"])
    flat().save(folder.trajectory)
    code, out, err = cortado_command("export", folder.path, "--to", "obj", "--every", 2)
    assert (code, out) == (0, f"The run is in {folder.path / 'obj'}.\n"), err
    names = {"particles_00000.obj", "particles_00001.obj", "solid_block.obj"}
    assert {one.name for one in (folder.path / "obj").iterdir()} == names
    code, _, err = cortado_command("export", folder.path, "--to", "obj")
    assert code == 2 and "is not empty; choose a new or an empty folder" in err
    code, _, err = cortado_command("export", tmp_path, "--to", "usd")
    assert code == 2 and "There is no run in" in err


# ---- for xarray --------------------------------------------------------------------------------------------------
def test_a_dataset_has_names_and_units(tmp_path):
    xarray = pytest.importorskip("xarray")
    found = trajectory().to_xarray()
    assert dict(found.sizes) == {"time": 3, "particle": 128, "space": 3, "phase": 2, "solid": 1, "rotation_axis": 3}
    units = {name: found[name].attrs["units"] for name in ("time", "position", "velocity", "mass_fraction", "density")}
    assert units == {"time": "s", "position": "m", "velocity": "m/s", "mass_fraction": "1", "density": "kg/m3"}
    np.testing.assert_array_equal(found["position"].sel(time=0.5, space="y"), trajectory().positions[1, :, 1])
    rotor = found.sel(solid="my rotor")
    np.testing.assert_array_equal(rotor["solid_position"], trajectory().solids["my rotor"].positions)
    assert rotor["solid_velocity"].isnull().all() and rotor["solid_rotation"].attrs["units"] == "rad"
    motion = trajectory().solids["my rotor"]
    raft = replace(motion, velocities=motion.positions + 1.0, angular_velocities=motion.rotations)
    both = replace(trajectory(), solids=SolidMotions({"raft": raft, "my rotor": motion})).to_xarray()["solid_velocity"]
    np.testing.assert_array_equal(both.sel(solid="raft"), motion.positions + 1.0)
    assert both.sel(solid="my rotor").isnull().all()
    found.to_netcdf(tmp_path / "run.nc")
    with xarray.open_dataset(tmp_path / "run.nc") as again:
        assert again["position"].dims == ("time", "particle", "space") and again["position"].attrs["units"] == "m"


# ---- what goes wrong ---------------------------------------------------------------------------------------------
def test_wrong_calls_are_sentences(tmp_path):
    new, run = tmp_path / "new", trajectory()
    (tmp_path / "mine.txt").write_text("kept")
    plane = cortado.load_scene("docs/figures/dam_break_plane.toml")
    other = "scene has 2 dimensions and 1 phases, but must be that of the trajectory, with 3 and 2"
    for made, arguments, words in [
        (run, (tmp_path, "stl"), r"to is 'stl', but must be one of ply, obj, glb, usd, vtp\."),
        (run, (tmp_path, "ply"), "is not empty; choose a new or an empty folder"),
        (replace(run, scene=None), (new, "ply"), "scene is missing, but must be given, as a trajectory from a file"),
        (run, (new, "ply", plane), other),
        (run[:0], (new, "ply"), "has no frame"),
        (run, (3, "ply"), "folder is 3, but must be the path"),
    ]:
        with pytest.raises(InputError, match=words):
            made.export(*arguments)
    assert not new.exists()


@pytest.mark.parametrize(("module", "to"), [("vtkmodules", "vtp"), ("pxr", "usd"), ("xarray", None)])
def test_a_missing_library_is_named(module, to, tmp_path, monkeypatch):
    formats._vtk.cache_clear()
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(InputError, match=r"is not installed: pip install [a-z-]+\.$"):
        trajectory().to_xarray() if to is None else trajectory().export(tmp_path, to)


@pytest.mark.parametrize("to", FORMATS)
def test_a_full_disk_is_a_sentence(to, tmp_path, monkeypatch):
    pytest.importorskip({"usd": "pxr", "vtp": "vtkmodules"}.get(to, "trimesh"))
    full = pytest.raises(ComputationError, match=r"cannot be written: .*free some space, or choose another")
    with largest_file(200), full:
        trajectory()[:1].export(tmp_path / "out", to)
    assert not list((tmp_path / "out").iterdir())


def test_what_has_gone_around_a_period_is_shown_within_it():
    """Particles, the surface, solids, the room of a picture, and the camera that follows a solid."""
    tables = {**scene().model_dump(), "picture": {"camera_path": {"kind": "follow", "solid": "my rotor"}}}
    tables["container"] = {**tables["container"], "periodic": [True, False, False]}
    made, along = scene_from_dict(tables), np.array([1.0, 0.0, 0.0])
    own, turns = replace(trajectory(), scene=made), np.random.default_rng(0).integers(-2, 4, (len(lattice()), 1))
    motion = own.solids["my rotor"]
    moved = SolidMotions({"my rotor": SolidMotion(motion.positions - 2.0 * along, motion.rotations)})
    lapped = replace(own, positions=own.positions + np.float32(turns * along), solids=moved)
    frames = [list(Exported(run, made).frames()) for run in (own, lapped)]
    for first, second in zip(*frames, strict=True):
        np.testing.assert_allclose(second.positions, first.positions, atol=1e-6)
        np.testing.assert_allclose(second.poses["my rotor"].position, first.poses["my rotor"].position, atol=1e-9)
        ends = [[one.surface.points.min(axis=0), one.surface.points.max(axis=0)] for one in (first, second)]
        np.testing.assert_allclose(ends[1], ends[0], atol=1e-3)
    first, second = (ShownRun(made, run) for run in (own, lapped))
    for run in (first, second):
        vars(run)["_motions"] = run.trajectory.solids
    np.testing.assert_allclose(second.stage.ends, first.stage.ends, atol=1e-6)
    np.testing.assert_allclose(second._view(2, second.stage).eye, first._view(2, first.stage).eye, atol=1e-6)
