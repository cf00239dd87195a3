"""Where something is computed changes no bit of it, also where a worker is killed half-way."""

import os
import pickle
import signal
import sys
import threading
import time
import warnings
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest

import cortado
from cortado import ComputationError, CortadoWarning, DivergedError, InputError, Problem, Simulation, executors
from cortado.cli.arguments import Where
from cortado.device import threads as calls
from cortado.device.threads import usable_cores
from cortado.errors import OutOfRangeError
from cortado.executors import Distributed, InProcess, local_workers
from cortado.gradients import EnsembleMean, Exact, RandomizedSmoothing
from dask_processes import PATIENCE, scheduler
from scenes import plane
from work_for_workers import FarFromHome, SlowValue, gpu_and_process, process, square

POINTS = [{"gravity": np.array([0.1 * k, -9.81])} for k in range(10)]


@pytest.fixture(scope="module")
def problem():
    simulation = Simulation(plane(), precision="float64")
    return Problem(simulation, 4, FarFromHome(simulation.positions))


@pytest.fixture(scope="module")
def processes(tmp_path_factory):
    """A scheduler and two workers, all processes of their own; the last test that has them kills them."""
    with scheduler(tmp_path_factory.mktemp("scheduler"), workers=2) as started:
        yield started


@pytest.fixture(scope="module")
def workers(processes):
    with Distributed(processes.address) as executor:
        at_work = set()
        while len(at_work) < 2:
            at_work |= set(executor.map(process, range(4)))
        yield executor


def bits(estimate):
    errors = estimate.standard_error or {}
    return [np.asarray(value).tobytes() for one in (estimate.gradient, errors) for value in one.values()], estimate.loss


def answer(function, number=0):
    return calls.call(calls.Payload.of(function), calls.pickled(number, "The item"))


def test_in_process_items_are_taken_one_after_the_other_as_they_are_needed_and_the_first_error_ends_it():
    told, taken, seen = [], [], []
    assert InProcess().map(square, iter(range(4)), lambda *pair: told.append(pair)) == [0, 1, 4, 9]
    assert told == [(0, 0), (1, 1), (2, 4), (3, 9)]
    items = (taken.append(number) or number for number in range(3))
    assert InProcess().map(lambda number: len(taken), items) == [1, 2, 3]

    def fails(number):
        seen.append(number)
        raise DivergedError(3, number, "take care")

    with pytest.raises(DivergedError) as caught:
        InProcess().map(fails, range(3))
    assert (caught.value.particle, seen) == (0, [0])


@pytest.mark.parametrize(
    "error",
    [DivergedError(5, 7, "less", "went through", 2), cortado.SceneError("a.toml", "solver.time_step", -1.0, "above 0")],
)
def test_errors_arrive_as_themselves(error):
    def fail(_):
        raise error

    back = pickle.loads(pickle.dumps(answer(fail)))
    assert type(back.error) is type(error) and str(back.error) == str(error)
    assert vars(back.error) == vars(error) and back.traceback == ""


def test_an_error_that_cannot_travel_is_told_in_words():
    class Odd(Exception):
        def __init__(self, one, two):
            super().__init__(f"{one} and {two}")

    def fail(_):
        raise Odd(1, 2)

    back = answer(fail)
    assert type(back.error) is RuntimeError and str(back.error) == "Odd: 1 and 2"
    assert "in fail" in back.traceback and "Odd: 1 and 2" in back.traceback


def test_what_cannot_be_sent_and_a_worker_with_other_versions_are_sentences(monkeypatch):
    with pytest.raises(InputError, match=r"^The function cannot be sent to another process: TypeError: .*\.$"):
        calls.Payload.of(threading.Lock().acquire)
    payload = calls.Payload.of(square)
    monkeypatch.setattr(calls, "versions", lambda: "Cortado 0.0.1, Warp 1.0 and NumPy 2.0")
    back = calls.call(payload, calls.pickled(3, "The item"))
    assert isinstance(back.error, InputError) and "must have Cortado" in str(back.error)


def test_a_worker_that_lacks_the_function_says_so(monkeypatch):
    monkeypatch.setattr(calls, "_functions", calls.OrderedDict())
    payload, item = calls.Payload.of(square), calls.pickled(3, "The item")
    assert isinstance(calls.call(payload.mention, item), calls.Lacking)
    assert calls.call(payload, item).result() == calls.call(payload.mention, item).result() == 9


class Exits:
    def __reduce__(self):
        sys.exit(1)


@pytest.mark.parametrize(
    ("function", "error", "words"),
    [
        (lambda _: sys.exit(3), ComputationError, r"^An item ended .* SystemExit: 3; what is .* not do so\.$"),
        (lambda _: signal.default_int_handler(signal.SIGINT, None), ComputationError, "by KeyboardInterrupt; what is"),
        (lambda _: Exits(), ComputationError, "by SystemExit: 1; what is computed"),
        (lambda _: threading.Lock(), InputError, "The result cannot be sent to another process: TypeError"),
    ],
)
def test_an_item_that_ends_its_process_or_has_no_result_to_send_is_an_error(function, error, words):
    with pytest.raises(error, match=words):
        raise answer(function).error


def test_an_executor_is_asked_for_by_its_type_and_is_no_part_of_what_an_estimator_is():
    with ThreadPoolExecutor(1) as pool, pytest.raises(InputError, match="executor is of the type ThreadPoolExecutor"):
        EnsembleMean(executor=pool)
    with pytest.raises(InputError, match="executor is the class InProcess"):
        RandomizedSmoothing(executor=InProcess)
    one, other = EnsembleMean(), EnsembleMean(executor=type("Other", (InProcess,), {})())
    assert one == other and hash(one) == hash(other) and repr(one) == repr(other)


def test_estimators_have_the_bits_that_they_have_alone(problem, workers):
    for made in (RandomizedSmoothing(samples=2), EnsembleMean(estimator=Exact())):
        wanted = problem.estimate(POINTS[1], made)
        found = problem.estimate(POINTS[1], replace(made, executor=workers))
        assert bits(found) == bits(wanted)


def test_many_points_have_the_bits_that_they_have_alone(problem, workers):
    told = []
    found = cortado.evaluate(problem, POINTS, executor=workers, on_result=lambda *pair: told.append(pair))
    assert [one.loss for one in found] == [problem.value(point) for point in POINTS]
    assert sorted(number for number, _ in told) == list(range(10)) and dict(told)[7] is found[7]
    found = cortado.evaluate(problem, POINTS, Exact(), workers)
    assert [bits(one) for one in found] == [bits(problem.estimate(point, Exact())) for point in POINTS]


def test_items_are_shared_out_and_a_function_is_made_once_a_process(workers):
    class Kept:
        def __call__(self, _):
            time.sleep(0.05)
            return os.getpid(), id(self)

    kept = Kept()
    found = {*workers.map(kept, range(12)), *workers.map(kept, range(12))}
    assert len({pid for pid, _ in found}) == 2 == len(found)


MAIN = """
class Loss:
    def value(self, end):
        return float(end.positions.sum())
    def adjoint(self, end):
        return 0 * end.positions + 1, 0 * end.positions
"""


def test_a_loss_of_the_main_module_travels(problem, workers):
    namespace = {"__name__": "__main__"}
    exec(MAIN, namespace)
    own = Problem(problem.simulation, 2, namespace["Loss"]())
    wanted = [own.value(point) for point in POINTS[:3]]
    assert workers.map(own.value, POINTS[:3]) == wanted


def test_the_error_of_the_first_item_that_has_one_is_raised(workers):
    def fail(number):
        if number == 2:
            time.sleep(0.3)
            raise DivergedError(5, 7, "take a smaller time step")
        if number > 2:
            raise ValueError("later")

    with pytest.raises(DivergedError, match=r"^The simulation diverged in step 5: particle 7 was lost; take a"):
        workers.map(fail, range(8))
    assert workers.map(square, range(3)) == [0, 1, 4]

    def wrong(_):
        raise ValueError("not of Cortado")

    with pytest.raises(ValueError, match="not of Cortado") as caught:
        workers.map(wrong, range(2))
    assert "in wrong" in caught.value.__notes__[0]


@pytest.mark.filterwarnings("ignore:time_step is")
@pytest.mark.parametrize("gradient", [None, Exact()])
@pytest.mark.parametrize("where", ["here", "workers"])
def test_what_diverges_is_nan_and_the_others_are_there(problem, request, gradient, where):
    executor = request.getfixturevalue("workers") if where == "workers" else InProcess()
    at_rest, far = (np.full_like(problem.simulation.positions, size) for size in (0.0, 1e5))
    points = [{"initial_velocities": velocities} for velocities in (at_rest, far, at_rest, far)]
    told = {}
    words = r"^2 of 4 points diverged, and the losses of these points are NaN\. The first failed point is point 1: The "
    with pytest.warns(CortadoWarning, match=words):
        found = cortado.evaluate(problem, points, gradient, executor, on_result=told.__setitem__)
    wanted = [problem.estimate(point, gradient) if gradient else problem.value(point) for point in points[::2]]
    for one, own in zip(found[::2], wanted, strict=True):
        assert one.diverged is None and (bits(one) == bits(own) if gradient else one.loss == own)
    for one in found[1::2]:
        assert np.isnan(one.loss) and isinstance(one.diverged, DivergedError)
        assert all(np.isnan(value).all() for value in one.gradient.values()) and len(one.gradient) == bool(gradient)
    assert sorted(told) == [0, 1, 2, 3] and np.isnan(told[1].loss)


@pytest.mark.filterwarnings("ignore:time_step is")
@pytest.mark.parametrize("gradient", [None, Exact()])
def test_what_is_out_of_range_is_treated_as_what_diverges(problem, gradient):
    first, far = problem.simulation.positions, np.full_like(problem.simulation.positions, 1e5)
    points = [{"viscosity": mu} for mu in (0.1, -0.1, np.nan)] + [{"initial_positions": first + 10.0}]
    words = r"^3 of 4 points cannot be run, and .* point 1: parameter viscosity is -0.1, but must be at least 0\.$"
    with pytest.warns(CortadoWarning, match=words):
        found = cortado.evaluate(problem, points, gradient)
    assert found[0].loss == problem.value(points[0]) and [np.isnan(one.loss) for one in found] == [False] + 3 * [True]
    assert all(isinstance(one.diverged, OutOfRangeError) for one in found[1:])
    with pytest.warns(CortadoWarning, match="^2 of 3 points diverged or cannot be run"):
        cortado.evaluate(problem, [*points[:2], {"initial_velocities": far}])
    with pytest.raises(InputError, match="parameter 'viscous' is unknown"):
        cortado.evaluate(problem, [*points, {"viscous": 0.1}])


@pytest.mark.filterwarnings("ignore:time_step is")
def test_where_no_point_has_a_run_the_first_error_is_raised_and_what_diverges_may_have_a_loss(problem, workers):
    far = {"initial_velocities": np.full_like(problem.simulation.positions, 1e5)}
    with pytest.raises(InputError, match=r"^parameter viscosity is -1\.0, but must be at least 0\.$"):
        cortado.evaluate(problem, [{"viscosity": -1.0}, far])
    with warnings.catch_warnings():
        warnings.filterwarnings("error", "1 of 2 points diverged")
        one, other = cortado.evaluate(problem, [POINTS[0], far], Exact(), workers, loss_if_diverged=np.inf)
    assert one.loss == problem.value(POINTS[0]) and other.loss == np.inf
    assert np.isnan(other.gradient["initial_velocities"]).all()
    with pytest.raises(InputError, match="loss_if_diverged is 'inf', but must be a number"):
        cortado.evaluate(problem, POINTS, loss_if_diverged="inf")


def test_warnings_and_observers_of_workers_are_heard(problem, workers):
    def warn(number):
        warnings.warn(f"mind number {number}", CortadoWarning, stacklevel=1)

    with pytest.warns(CortadoWarning) as caught:
        workers.map(warn, range(3))
    assert sorted(str(one.message) for one in caught) == [f"mind number {k}" for k in range(3)]
    heard, alone = [], EnsembleMean(estimator=Exact(), executor=workers)
    found = problem.estimate(POINTS[0], alone, lambda step, bar: heard.append(step))
    assert heard == [4, 3, 2, 1, 0] * 4 and bits(found) == bits(problem.estimate(POINTS[0], alone))
    with pytest.raises(InputError, match="An executor cannot be used within a computation of another executor"):
        cortado.evaluate(problem, POINTS[:2], alone, workers)


def test_a_worker_that_is_killed_half_way_changes_nothing(problem, processes, workers):
    arrived = []

    def kill(number, result):
        arrived.append(number)
        if len(arrived) == len(POINTS) // 2:
            processes.workers[0].kill()

    with pytest.warns(CortadoWarning, match="was lost; another worker computes the lost items again"):
        found = workers.map(SlowValue(problem), POINTS, kill)
    assert [loss for loss, _ in found] == [problem.value(point) for point in POINTS]
    assert sorted(arrived) == list(range(len(POINTS)))
    assert {pid for _, pid in found} == {worker.pid for worker in processes.workers}
    with pytest.raises(ComputationError, match=r"^The scheduler tcp://127\.0\.0\.1:\d+ was lost, and"):
        workers.map(SlowValue(problem), POINTS, lambda *_: processes.process.kill())


def test_a_scheduler_without_workers_is_left_in_the_end():
    import distributed

    options = {"host": "127.0.0.1", "port": 0, "dashboard_address": ":0", "dashboard": False}
    here = {"cls": distributed.Scheduler, "options": options}
    with (
        distributed.SpecCluster({}, here, silence_logs=False) as cluster,
        Distributed(cluster.scheduler_address, patience=0.5) as executor,
        pytest.raises(ComputationError, match=r"has had no worker for \d+ s; start workers, as with `dask worker"),
    ):
        executor.map(square, range(3))


def test_a_scheduler_or_a_package_that_is_not_there_is_a_sentence(monkeypatch):
    monkeypatch.setattr(executors, "REACHED", 0.2)
    for address, words in [
        ("tcp://127.0.0.1:1", "no scheduler answers there within 0.2 s"),
        ("here", "missing port"),
        (3, "scheduler is 3"),
    ]:
        with pytest.raises(InputError, match=words):
            Distributed(address)
    monkeypatch.setitem(sys.modules, "distributed", None)
    wanted = r"^Several processes need Dask's distributed, which is not installed: pip install distributed"
    with pytest.raises(InputError, match=wanted):
        Distributed("tcp://127.0.0.1:8786")
    with pytest.raises(InputError, match=wanted), local_workers(2):
        pass


def test_points_wait_for_the_first_worker(problem, tmp_path):
    with scheduler(tmp_path, workers=0) as processes, Distributed(processes.address) as executor:
        assert executor.threads() == 0
        later = threading.Timer(1.5, processes.start_worker)
        later.start()
        found = cortado.evaluate(problem, POINTS, executor=executor)
        later.join()
    assert [one.loss for one in found] == [problem.value(point) for point in POINTS]


@pytest.mark.filterwarnings("ignore:The worker .* was lost")
def test_each_process_has_one_gpu_also_when_it_is_started_again(monkeypatch):
    monkeypatch.setattr("cortado.executors.visible_gpus", lambda: ["3", "GPU-5f1c"])

    def at_work(executor):
        found, end = {}, time.monotonic() + PATIENCE
        while len(found) < 2 and time.monotonic() < end:
            found.update(executor.map(gpu_and_process, range(8)))
        return found

    with local_workers(device="cuda") as executor:
        first = at_work(executor)
        os.kill(first["3"], signal.SIGKILL)
        second = at_work(executor)
    assert first.keys() == second.keys() == {"3", "GPU-5f1c"}
    assert first["3"] != second["3"] and first["GPU-5f1c"] == second["GPU-5f1c"]


@pytest.mark.filterwarnings("ignore:The worker .* was lost")
def test_worker_processes_are_there_again_however_they_ended():
    with local_workers(1) as executor:
        for way in (lambda: sys.exit(1), lambda: os.kill(os.getpid(), signal.SIGKILL)):
            with pytest.raises(ComputationError, match=r"ended its process|was given up, as 4 workers were lost"):
                executor.map(lambda number, way=way: way() if number < 2 else number, range(3))
            assert executor.map(square, range(3)) == [0, 1, 4]
        for code in (signal.SIGTERM, signal.SIGKILL):
            (pid,) = set(executor.map(process, range(2)))
            os.kill(pid, code)
            assert executor.map(square, range(3)) == [0, 1, 4]
            assert set(executor.map(process, range(2))).isdisjoint({pid})


def test_cores_are_shared_out(monkeypatch):
    monkeypatch.setattr("cortado.executors.usable_cores", lambda: 8)
    environments = executors._environments
    assert environments(None, "cpu") == [{"CORTADO_CORES": "1"}] * 8
    assert environments(3, "cpu") == [{"CORTADO_CORES": "2"}] * 3
    assert environments(9, "cpu") == [{"CORTADO_CORES": "1"}] * 9


def test_no_more_processes_than_items(monkeypatch):
    monkeypatch.setattr("cortado.executors.usable_cores", lambda: 2)
    started = []

    @contextmanager
    def local_workers(number, device):
        started.append((number, device))
        yield InProcess()

    monkeypatch.setattr("cortado.executors.local_workers", local_workers)
    for workers, items in ((40, 1), (3, 8), (2, 0)):
        with Where(workers=workers).executor("cuda:0", items):
            pass
    assert started == [(1, "cuda"), (3, "cuda"), (1, "cuda")]
    with pytest.raises(
        InputError, match=r"^--workers is 65, but must be at most 64, as this machine has 2 cores; more"
    ):
        Where(workers=65)


@pytest.mark.parametrize(
    "number, device, words",
    [
        (10**6, "cpu", r"number is 1000000, but must be at most \d+, as this machine has \d+ core"),
        (0, "cpu", "number is 0"),
        (None, "cuda:1", "device is 'cuda:1'"),
        (None, "cuda", "1 worker processes need a GPU each, but there are 0 GPUs"),
    ],
)
def test_wrong_local_workers_are_a_sentence(monkeypatch, number, device, words):
    monkeypatch.setattr("cortado.executors.visible_gpus", list)
    with pytest.raises(InputError, match=words), local_workers(number, device):
        pass


def test_the_cores_of_a_process_can_be_limited(monkeypatch):
    monkeypatch.delenv("CORTADO_CORES", raising=False)
    everything = usable_cores()
    monkeypatch.setenv("CORTADO_CORES", "1")
    assert usable_cores() == 1
    monkeypatch.setenv("CORTADO_CORES", "100000")
    assert usable_cores() == everything
    monkeypatch.setenv("CORTADO_CORES", "many")
    with pytest.raises(InputError, match="CORTADO_CORES is 'many'"):
        usable_cores()
