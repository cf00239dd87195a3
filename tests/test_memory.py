"""What is needed against what is free: estimates against what is measured, and sentences that come in time."""

import subprocess
import sys
from collections.abc import Callable

import pytest

from bad_scenes import plane
from cortado import InputError, Problem, SceneError, Simulation, losses
from cortado.device import threads
from cortado.render.renderer import scene_renderer
from cortado.scene.scene import scene_from_dict

MEASURE = """
import sys
import numpy as np
from cortado import Problem, Simulation, losses
from cortado.device import threads
from benchmarks.bench.scene import dam_break

def run(particles):
    simulation = Simulation(dam_break(particles), precision=sys.argv[1])
    simulation.rollout(1).forward(keep=False)
    forward = peak()
    problem = Problem(simulation, 1, losses.FinalPositions(simulation.positions))
    problem.value_and_gradient({"gravity": np.array(simulation.scene.forces.gravity)})
    return simulation, forward

def peak():
    # Not ru_maxrss, which begins with that of the process that started this one.
    status = dict(line.split(":", 1) for line in open("/proc/self/status"))
    return 1024 * int(status["VmHWM"].split()[0])

run(27)
before = peak()
simulation, forward = run(60_000)
real = simulation.precision.bytes
parts = threads.simulation_parts(simulation.particles, len(simulation.walls), simulation.solver.search.capacity, real)
back = threads.gradient_parts(simulation.particles, 5, real)
print((forward - before) / sum(parts.values()), (peak() - forward) / sum(back.values()))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="the peak is read as Linux writes it")
@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_the_estimate_is_what_a_run_and_its_gradient_take(precision):
    done = subprocess.run([sys.executable, "-c", MEASURE, precision], capture_output=True, text=True, check=True)
    for ratio in map(float, done.stdout.splitlines()[-1].split()):
        assert 1 / 1.5 < ratio < 1.5


@pytest.fixture
def scarce(monkeypatch) -> Callable[[float], None]:
    return lambda free: monkeypatch.setattr(threads, "available", lambda device=None: free)


def problem() -> Problem:
    simulation = Simulation(scene_from_dict(plane()))
    return Problem(simulation, 2, losses.FinalPositions(simulation.positions))


def test_a_scene_is_refused_before_it_is_cut_into_particles(scarce):
    tall = plane(container={"shape": "box", "lower": [0, 0], "upper": [1, 4e6]})
    scarce(1e9)
    with pytest.raises(SceneError, match=r"spacing is 0\.1, but must be larger.* 8e\+07 wall.* only 1 GB are free"):
        scene_from_dict(tall)


@pytest.mark.parametrize(
    ("work", "words"),
    [
        (lambda one: Simulation(one.simulation.scene), "50 particles of fluid.* larger spacing"),
        (lambda one: one.simulation.rollout(1000), "1e\\+03 steps.* take fewer steps"),
        (lambda one: one.simulation.run(2), "frames.* larger record_every"),
        (lambda one: one.value_and_gradient({"gravity": [0.0, -9.81]}), "the gradient of 50 particles"),
        (lambda one: scene_renderer(one.simulation), "nodes.* larger cell"),
    ],
)
def test_what_does_not_fit_is_refused_in_a_sentence(scarce, work, words):
    one = problem()
    scarce(1e3)
    with pytest.raises(InputError, match=f"This needs about .* GB of memory, most of it for .*{words}"):
        work(one)
    scarce(1e9)
    work(one)


def test_the_limit_of_a_process_and_of_a_container_counts(monkeypatch, tmp_path):
    program = "from cortado.device import threads; print(threads.available())"
    line = f'ulimit -v 2000000; "{sys.executable}" -c "{program}"'
    free = float(subprocess.run(["bash", "-c", line], capture_output=True, text=True, check=True).stdout)
    assert 1e8 < free < 2.05e9
    for name, content in {"max": "3000", "current": "1500", "stat": "anon 1\ninactive_file 400"}.items():
        (tmp_path / f"memory.{name}").write_text(content)
    monkeypatch.setattr(threads, "_CGROUP", tmp_path)
    assert threads.available() == 1900.0
    (tmp_path / "memory.max").write_text("max")
    assert threads.available() > 1e6
