"""What is compiled for a step, and when: all at once, only what is needed, by several processes, into any cache."""

import os
import shutil
import subprocess
import sys
from functools import partial
from threading import Event, Timer

import numpy as np
import pytest
import warp as wp

import cortado
from compiling_notice import COMPILING, UNOPTIMISED
from cortado.device import modules
from cortado.device.modules import DEEP, SHALLOW, UNUSED, is_derivative, kernel_module, kernels_of
from cortado.device.threads import CORES
from scenes import plane, pour

FIRST = {
    "cells_float32",
    "containment_float32",
    "convergence_float32",
    "integration_forward_float32",
    "mixture_forward_1_float32",
    "neighbours_forward_cubic_spline_float32",
    "pairwise_forward_cubic_spline_float32",
    "pcisph_forward_cubic_spline_float32",
    "sum_and_maximum_float32_2",
}
"""What the first step of one phase loads. Every module is about 0.1 s of everybody's first step, more where its kernels
sum over neighbours: what joins this list should be needed by every scene."""
BACK = {
    "add_float32",
    "integration_derivative_float32",
    "matching_float32",
    "mixture_derivative_1_float32",
    "pairwise_derivative_cubic_spline_float32",
    "pcisph_derivative_cubic_spline_float32",
    "sum_float32",
    "sum_float32_1",
    "sum_float32_3",
    "sum_float64",
}
"""What the first gradient adds: no tangents, nothing that a tape needs."""
ONE_PHASE = ["solver.kind=pcisph", "forces.viscosity=pairwise", "discretisation.kernel=cubic_spline"]
RUN = """
import os
import cortado
from warp._src.context import user_modules

def loaded():
    return sorted(name.removeprefix("cortado_") for name, module in user_modules.items() if module.execs)

simulation = cortado.Simulation(cortado.load_scene("docs/figures/dam_break_plane.toml", CHANGES))
WORK
"""


def process(cache, work, changes=ONE_PHASE):
    environment = {**os.environ, "WARP_CACHE_PATH": str(cache), CORES: ""}
    program = UNOPTIMISED + RUN.replace("WORK", work).replace("CHANGES", repr(changes))
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    return subprocess.Popen([sys.executable, "-c", program], env=environment, text=True, **pipes)


def result(started):
    out, err = started.communicate(timeout=300)
    assert started.returncode == 0, err
    return out, err


GRADIENT = """
simulation.run(1)
print(*loaded())
problem = cortado.Problem(simulation, 1, cortado.losses.FinalPositions(simulation.positions + 0.01))
problem.value_and_gradient({"gravity": [0.0, -9.81]})
print(*loaded())
"""


def test_one_phase_loads_what_it_needs_and_no_more(tmp_path):
    out, err = result(process(tmp_path, GRADIENT))
    first, both = (set(line.split()) for line in out.splitlines())
    assert first == FIRST
    assert both - first == BACK
    assert all(COMPILING.fullmatch(line + "\n") for line in err.splitlines()) and err.count("\n") == 2
    names = [folder.name.rpartition("_")[0] for folder in tmp_path.rglob("wp_cortado_*") if folder.is_dir()]
    assert len(set(names)) == len(names) == len(both)  # of which none got kernels after it was compiled


def test_two_processes_start_cold_at_once(tmp_path):
    work = "print(float(simulation.run(3)[-1].positions.sum()).hex())"
    started = [process(tmp_path, work) for _ in range(2)]
    (one, _), (other, _) = (result(each) for each in started)
    assert one == other
    again, err = result(process(tmp_path, work))
    assert again == one and err == ""


FORK = """
child = os.fork()
print(float(simulation.run(2)[-1].positions.sum()).hex() + "\\n", end="", flush=True)  # in one write
if child == 0:
    raise SystemExit
assert os.waitpid(child, 0)[1] == 0
cortado.Problem(simulation, 1, cortado.losses.FinalPositions(simulation.positions)).value({})
"""
FALLING = ["forces.pressure=false", "forces.viscosity=none"]
"""Without sums over neighbours, which take long to compile."""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="forks")
def test_a_fork_before_anything_is_compiled(tmp_path):
    """The child deletes folders of Warp's that it shares with its parent, which compiles more after that."""
    out, err = result(process(tmp_path, FORK, FALLING))
    child, parent = out.split()
    assert child == parent and "Traceback" not in err


TENSION = {"gravity": [0.0, -9.81], "viscosity": "pairwise", "surface_tension": 0.01}
SCENES = {
    "one phase": plane(),
    "pairwise, surface tension": plane(forces=TENSION),
    "surface tension by curvature": plane(
        forces={**TENSION, "viscosity": "stress"}, solver={"kind": "projection", "time_step": 0.0021}
    ),
    "no pressure": plane(forces={"gravity": [0.0, -9.81], "pressure": False}),
    "two phases, an emitter": pour(),
}


@pytest.fixture
def launched(monkeypatch):
    """The modules of the kernels that are launched."""
    found, launch = set(), wp.launch

    def noted(kernel, *arguments, **options):
        found.add(kernel.module.name)
        return launch(kernel, *arguments, **options)

    monkeypatch.setattr(wp, "launch", noted)
    return found


@pytest.mark.filterwarnings("ignore::cortado.CortadoWarning")
@pytest.mark.parametrize("scene", SCENES.values(), ids=SCENES)
def test_what_a_step_launches_is_compiled_ahead_and_little_more(launched, scene):
    """What Simulation itself does is no launch."""
    simulation = cortado.Simulation(scene)
    assert not launched
    ahead = {k.module.name for k in kernels_of(simulation.solver) if not is_derivative(k.module)}
    simulation.run(1)
    assert launched <= ahead
    if scene.forces.pressure:
        assert ahead == launched


def test_what_a_step_back_launches_is_compiled_ahead(launched):
    simulation = cortado.Simulation(plane())
    problem = cortado.Problem(simulation, 1, cortado.losses.FinalPositions(np.zeros_like(simulation.positions)))
    derivative = cortado.gradients.Exact().derivative(simulation.rollout(1))
    ahead = {kernel.module.name for kernel in kernels_of(derivative)}
    problem.value_and_gradient({"gravity": [0.0, -9.81]})
    back = {name for name in launched if "_derivative_" in name}
    assert back and back <= ahead


@pytest.mark.parametrize("kind", ["pcisph", "projection"])
def test_kernels_of_a_module_have_names_of_their_own(kind):
    """Of two of one name a captured graph on a CPU launches one for both."""
    simulation = cortado.Simulation(plane(solver={"kind": kind, "time_step": 0.002}))
    derivative = cortado.gradients.Exact().derivative(simulation.rollout(1))
    kernels = {*kernels_of(simulation.solver), *kernels_of(derivative)}
    names = [(kernel.module.name, kernel.key) for kernel in kernels]
    assert len(names) == len(set(names)) > 15


def test_what_is_compiled_meanwhile_is_waited_for_and_not_compiled_again(monkeypatch):
    """Not even where it has not ended when it is asked for."""
    solver, done, wanted = cortado.Simulation(plane()).solver, set(), Event()
    compiled = []

    def slowly(modules, *_):
        wanted.wait(10.0)
        compiled.extend(modules)
        done.update(modules)

    monkeypatch.setattr(modules, "_compile_all", slowly)
    monkeypatch.setattr(modules, "_is_compiled", lambda module, device: module in done)
    monkeypatch.setattr(modules, "usable_cores", lambda: 2)
    modules.compile_meanwhile(solver, wp.get_device("cpu"))
    assert not compiled
    Timer(0.1, wanted.set).start()
    modules.compile_ahead(solver, wp.get_device("cpu"))
    assert len(compiled) == len(set(compiled)) == len(done) > 1


def test_kernels_for_a_cpu_are_vectorised_deeper_unless_flags_are_given(monkeypatch):
    deeper = f"-march=native -mllvm={SHALLOW}", f"-march=native -mllvm={DEEP} {UNUSED}"
    for given, wanted in (deeper, *((one, one) for one in ("-march=native -O1", "", None))):
        monkeypatch.setattr(wp.config, "cpu_compiler_flags", given)
        assert kernel_module("of_a_test").options["cpu_compiler_flags"] == wanted


def test_kernels_have_the_flags_that_were_measured():
    program = "import warp; print(warp.config.cpu_compiler_flags)"  # in the tests they are others
    found = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert SHALLOW in found.stdout
    kernels = kernels_of(cortado.Simulation(plane()).solver)
    assert kernels and all(kernel.module.options["cpu_compiler_flags"] is not None for kernel in kernels)


KERNEL = """
import sys
import warp as wp
from cortado.device.modules import complaint, start_warp

@wp.kernel(module="unique")
def twice(x: wp.array(dtype=float)):
    i = wp.tid()
    x[i] = 2.0 * x[i]

start_warp()
x = wp.ones(3, dtype=float, device="cpu")
try:
    wp.launch(twice, 3, inputs=[x], device="cpu")
except Exception as error:
    print(complaint(error))
else:
    print(x.numpy().sum(), wp.config.kernel_cache_dir)
"""


@pytest.fixture(scope="module")
def compiled(tmp_path_factory):
    """The program, and a cache that a run of it has filled."""
    folder = tmp_path_factory.mktemp("compiled")
    (folder / "twice.py").write_text(KERNEL)
    out, err = run(folder / "twice.py", folder / "cache", folder)
    assert out.startswith("6.0") and err == ""
    return folder


def run(program, cache, temporary):
    """What the kernel prints, with this cache, and what it warns of."""
    environment = {**os.environ, "WARP_CACHE_PATH": str(cache), "TMPDIR": str(temporary)}
    done = subprocess.run([sys.executable, program], capture_output=True, env=environment, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return done.stdout, done.stderr


@pytest.fixture
def cache(compiled, tmp_path):
    """The same, to be damaged."""
    return shutil.copytree(compiled / "cache", tmp_path / "cache")


@pytest.fixture
def twice(compiled, tmp_path):
    return partial(run, compiled / "twice.py", temporary=tmp_path)


@pytest.mark.skipif(sys.platform != "linux", reason="object files are looked at on Linux")
@pytest.mark.parametrize("damage", [lambda file: file[:-50], lambda file: b""])
def test_a_damaged_kernel_is_compiled_again_elsewhere(twice, cache, damage):
    (file,) = cache.rglob("*.o")
    file.write_bytes(damage(file.read_bytes()))
    out, err = twice(cache)
    assert out.startswith("6.0") and len(err.splitlines()) == 1
    assert f"({file.parent.name} in it is damaged and should be deleted)" in err


def test_a_damaged_note_of_a_kernel_is_said_in_a_sentence(twice, cache):
    (file,) = cache.rglob("*.meta")
    file.write_bytes(file.read_bytes()[:100])
    out, _ = twice(cache)
    assert out.startswith(f"A compiled kernel in {file.parent.parent} cannot be used (") and len(out.splitlines()) == 1
    assert "delete that folder, or set the environment variable WARP_CACHE_PATH to another one." in out


def test_a_cache_that_cannot_be_written_is_replaced(twice, tmp_path):
    (tmp_path / "file").touch()
    out, err = twice(tmp_path / "file" / "cache")
    total, folder = out.split()
    assert total == "6.0" and folder.startswith(str(tmp_path / "cortado-kernels-")) and not os.path.exists(folder)
    assert err.startswith(f"Warning: Compiled kernels cannot be kept in {tmp_path / 'file' / 'cache'}")
    assert len(err.splitlines()) == 1 and "(Not a directory)" in err and "WARP_CACHE_PATH" in err


def test_what_another_process_is_compiling_is_not_damaged(tmp_path):
    from cortado.device.modules import _trouble, complaint

    assert complaint(ValueError("steps")) is None and complaint(OSError(28, "No space left on device")) is None
    for name in ("wp_cortado_a_846ebbe_p512_t139785425587072", "wp_cortado_a_846ebbe"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "a.o").write_bytes(b"\x7fELF, and no more yet")
    assert _trouble(str(tmp_path)) == "wp_cortado_a_846ebbe in it is damaged and should be deleted"
    (tmp_path / "wp_cortado_a_846ebbe" / "a.o").unlink()
    assert _trouble(str(tmp_path)) is None
