"""Threads take turns, a fork leaves a child that works, and simulations are copied."""

import copy
import os
import pickle
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from threading import Barrier, Event
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp

from cortado import ComputationError, InputError, Problem, Simulation, losses
from cortado.device.threads import WARP, Turn
from scenes import plane, splash, two_layers

DOWN = {"gravity": np.array([0.0, -9.81, 0.0])}
PATIENCE = 60.0
"""Seconds after which something hangs."""


@pytest.fixture(autouse=True)
def busy_threads():
    """Threads that change places as often as they can."""
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-5)
    yield
    sys.setswitchinterval(interval)


def problem_of(simulation, steps=20):
    return Problem(simulation, steps, losses.FinalPositions(np.zeros_like(simulation.positions)))


def gradient(problem, gravity=DOWN):
    return problem.value_and_gradient(gravity)[1]["gravity"].tobytes()


def in_threads(number, work):
    """What ``work`` returns in each of so many threads that begin together."""
    together = Barrier(number)

    def begin(thread):
        together.wait()
        return work(thread)

    with ThreadPoolExecutor(number) as pool:
        return list(pool.map(begin, range(number), timeout=PATIENCE))


def test_threads_on_one_simulation_get_their_own_gradients():
    simulation = Simulation(splash(), precision="float64")
    problems = [problem_of(simulation, 15), problem_of(simulation, 15), problem_of(simulation, 25)]
    points = [{"gravity": np.array([x, -9.81, 0.0])} for x in (0.0, 1.0, 2.0)]
    wanted = [gradient(problem_of(simulation, n), point) for n, point in zip((15, 15, 25), points, strict=True)]
    found = in_threads(3, lambda t: [gradient(problems[t], points[t]) for _ in range(5)])
    assert found == [[one] * 5 for one in wanted]
    shared = in_threads(3, lambda t: [gradient(problems[0], points[t]) for _ in range(5)])
    assert shared == [[gradient(problems[0], point)] * 5 for point in points]


def test_threads_with_new_simulations_of_their_own():
    def work(thread):
        problem = problem_of(Simulation(splash(), precision="float64"))
        return [gradient(problem) for _ in range(3)]

    assert len({one for found in in_threads(4, work) for one in found}) == 1


def test_another_simulation_gets_in_where_a_graph_is_replayed(monkeypatch):
    mine, other = (problem_of(Simulation(splash()), 3) for _ in range(2))
    wanted = mine.value(DOWN)  # the next evaluation replays graphs alone
    replay, within, done = wp.capture_launch, Event(), Event()

    def slowly(graph):
        if not (within.is_set() or WARP._entries):  # that of a reset is too short to lend Warp
            within.set()
            assert done.wait(PATIENCE)
        replay(graph)

    monkeypatch.setattr(wp, "capture_launch", slowly)
    with ThreadPoolExecutor(1) as pool:
        running = pool.submit(mine.value, DOWN)
        assert within.wait(PATIENCE)
        assert other.value(DOWN) == wanted
        done.set()
        assert running.result(PATIENCE) == wanted


def test_an_interruption_while_a_thread_waits_leaves_nothing_taken():
    turn = Turn(SimpleNamespace(is_cpu=True))
    with pytest.raises(KeyboardInterrupt), turn, WARP.lent():
        raise KeyboardInterrupt

    def enter():
        with turn:
            return True

    with ThreadPoolExecutor(1) as pool:
        assert pool.submit(enter).result(PATIENCE)


def test_a_forked_process_has_no_gpu():
    turn = Turn(SimpleNamespace(is_cpu=False))
    turn.forked()
    with pytest.raises(ComputationError, match="forked from the simulation's process"):
        turn.__enter__()


@pytest.mark.parametrize("copied", [lambda it: pickle.loads(pickle.dumps(it)), copy.deepcopy], ids=["pickle", "copy"])
@pytest.mark.parametrize("made", [splash, two_layers])
def test_a_copy_gives_the_same_bits(made, copied):
    problem = problem_of(Simulation(made(), precision="float64"), 3)
    wanted = gradient(problem)
    again = copied(problem)
    assert again.fingerprint == problem.fingerprint
    assert gradient(again) == wanted
    assert copied(problem.simulation).run(2).positions.tobytes() == problem.simulation.run(2).positions.tobytes()


def test_a_copied_loss_of_pictures_gives_the_same_bits():
    simulation = Simulation(two_layers(), precision="float64")
    renderer = simulation.renderer(resolution=[12, 8])
    problem = Problem(simulation, 2, losses.Image(renderer, np.zeros(renderer.shape)))
    wanted, again = gradient(problem), pickle.loads(pickle.dumps(problem))
    assert again.fingerprint == problem.fingerprint
    assert gradient(again) == wanted and np.frombuffer(wanted).any()
    state = simulation.run(1)[-1]
    assert pickle.loads(pickle.dumps(renderer)).render(state).tobytes() == renderer.render(state).tobytes()


def test_a_pickle_whose_points_have_changed_is_refused(tmp_path):
    points = np.stack(np.meshgrid(*[np.arange(0.05, 0.3, 0.05)] * 2), axis=-1).reshape(-1, 2)
    np.save(tmp_path / "points.npy", points)
    fluid = {"shape": "points", "file": str(tmp_path / "points.npy"), "phase": "water"}
    pickled = pickle.dumps(Simulation(plane(fluid=[fluid])))
    assert pickle.loads(pickled).particles == len(points)
    np.save(tmp_path / "points.npy", points + 0.01)
    with pytest.raises(InputError, match="file of points in the scene has changed"):
        pickle.loads(pickled)


FORKS = """
import multiprocessing, sys, threading
import numpy as np
from cortado import Problem, Simulation, losses
from benchmarks.bench.scene import dam_break

def gradient(x):
    return problem.value_and_gradient({"gravity": np.array([x, -9.81, 0.0])})[1]["gravity"].tobytes()

simulation = Simulation(dam_break(4500))
assert not simulation.solver.launch.capturable
problem = Problem(simulation, 1, losses.FinalPositions(0.9 * simulation.positions))
points = [0.0, 1.0]
wanted = [gradient(x) for x in points]
going = True
def others():
    own = Problem(Simulation(dam_break(100)), 20, lambda positions, velocities, loss: None)
    while going:
        own.value({})
threads = [threading.Thread(target=others), threading.Thread(target=lambda: [gradient(2.0) for _ in range(3)])]
for thread in threads:
    thread.start()
with multiprocessing.get_context("fork").Pool(2) as pool:
    found = pool.map(gradient, points)
going = False
for thread in threads:
    thread.join()
print(found == wanted)
"""


@pytest.mark.skipif(not hasattr(os, "fork") or (os.cpu_count() or 1) < 2, reason="needs forks, and cores")
def test_forks_after_use_and_while_others_compute():
    done = subprocess.run([sys.executable, "-c", FORKS], capture_output=True, text=True, timeout=2 * PATIENCE)
    assert done.stdout.split()[-1] == "True", done.stderr
