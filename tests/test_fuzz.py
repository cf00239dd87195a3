"""The fuzz tier itself: that it sees what is wrong, that a case repeats, and that it goes on where it was stopped."""

import json
import os
import signal
import subprocess
import sys
import time
import tomllib
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from cortado import InputError, Trajectory
from cortado.optimisation.task_files import load_task
from cortado.scene.scene import scene_from_dict
from fuzz import answers, bases, judge, oddities
from fuzz.campaign import Campaign
from fuzz.cases import Case, Family
from fuzz.environments import ENVIRONMENTS, shell_script
from fuzz.hostile import make_hostile
from fuzz.mutations import mutate
from fuzz.processes import Kill, Limits, call
from fuzz.text_mutations import mutate_text, option, override
from fuzz.toml_text import to_toml
from scenes import plane

ROOT = Path(__file__).parent.parent


def judged(folder, function, limits=Limits(), **options):  # noqa: B008 frozen
    """Complaints about a function that is called as a program."""
    return judge.complaints(call(function, ("test",), folder, limits, **options), limits)


def say(code, *lines):
    sys.stderr.writelines(f"{line}\n" for line in lines)
    sys.exit(code)


def fail():
    raise RuntimeError("inside")


def wait_long():
    time.sleep(30.0)


def hold(size):
    held = bytearray(size)
    held[::4096] = b"1" * len(held[::4096])
    time.sleep(30.0)


@pytest.mark.parametrize(
    "program", [lambda: None, partial(say, 2, "scene.toml: name is 3."), partial(say, 1, "Warning: odd.", "It failed.")]
)
def test_a_good_end_is_not_complained_of(tmp_path, program):
    assert judged(tmp_path, program) == []


@pytest.mark.parametrize(
    ("program", "words"),
    [
        (fail, "Traceback"),
        (partial(say, 3, "Something."), "exit code 3"),
        (partial(say, 2, "One line.", "Another."), "2 lines on stderr"),
        (partial(say, 0, "Oh."), "all is well, but"),
        (partial(say, 2, "A \x1b[31m name."), "control character"),
        (partial(say, 2, "a" * 2000), "characters on stderr"),
        (lambda: os.kill(os.getpid(), signal.SIGSEGV), "SIGSEGV"),
    ],
)
def test_a_bad_end_is_complained_of(tmp_path, program, words):
    assert any(words in complaint for complaint in judged(tmp_path, program))


def test_a_hang_is_found_with_its_place(tmp_path):
    found = judged(tmp_path, wait_long, Limits(seconds=0.3))
    assert len(found) == 1 and found[0].startswith("hung for more than 0.3 s in wait_long")
    outcome = call(wait_long, ("test",), tmp_path, kill=Kill(0.05, signal.SIGTERM))
    assert outcome.code == -signal.SIGTERM and outcome.seconds < 5.0


def test_work_that_says_that_it_takes_long_is_no_hang(tmp_path):
    def pack(said):
        print(said, end="", file=sys.stderr, flush=True)
        wait_long()

    assert judged(tmp_path, partial(pack, "Packing the particles of round bodies, 226,031 in all"), Limits(0.3)) == []
    done = "Packing the particles of round bodies, 226,031 in all: 3.1 s"
    assert len(judged(tmp_path, partial(pack, done), Limits(0.3))) == 1


def test_much_memory_is_found_and_not_that_of_this_process(tmp_path):
    usual = call(lambda: None, ("test",), tmp_path).memory
    assert judged(tmp_path, lambda: None, Limits(memory=usual + 50_000_000)) == []
    found = judged(tmp_path, partial(hold, 100_000_000), Limits(memory=usual + 50_000_000))
    assert len(found) == 1 and "held" in found[0]
    held = np.ones(100_000_000, dtype=np.uint8)
    assert call(lambda: None, ("test",), tmp_path).memory < usual + len(held) // 2


def trajectory_of(positions, at=0.3):
    """Two frames: the particles all in one place, and where they are given."""
    frames = np.array([np.broadcast_to(at, positions.shape), positions])
    return Trajectory(np.arange(2.0), np.arange(2), frames, np.zeros_like(frames), {"converged": np.ones(1, bool)})


def test_a_particle_that_leaked_is_found():
    scene = plane()
    inside = trajectory_of(np.array([[0.0, 0.1], [0.7 + 0.49 * 0.05, 0.8]]))
    outside = trajectory_of(np.array([[0.3, 0.1], [0.7 + 0.51 * 0.05, 0.1]]))
    nowhere = trajectory_of(np.array([[0.3, np.nan], [0.3, 0.1]]))
    assert answers.trajectory_complaints(scene, inside) == []
    assert "1 of 2 particles end outside" in answers.trajectory_complaints(scene, outside)[0]
    assert "not finite in frame 1" in answers.trajectory_complaints(scene, nowhere)[0]
    free = plane(forces={"gravity": [0.0, -9.81], "pressure": False})
    assert answers.trajectory_complaints(free, outside) == []


def test_a_nozzle_may_hold_its_particles_outside():
    tables = bases.scenes()["jet"]
    tables["container"] |= {"lid": True, "height": 0.055}
    scene = scene_from_dict(tables)
    waiting = scene.emitter[0].particles(scene.discretisation.spacing)
    assert not scene.container.contains(waiting, 0.0).all()
    fluid = np.tile([[0.0, 0.02, 0.0]], (len(waiting), 1))
    held = trajectory_of(np.concatenate([fluid, waiting]), at=np.zeros(3))
    lost = trajectory_of(np.concatenate([waiting, fluid]), at=np.zeros(3))
    assert answers.trajectory_complaints(scene, held) == []
    assert "end outside" in answers.trajectory_complaints(scene, lost)[0]


def test_a_folder_without_what_was_asked_for_is_found(tmp_path):
    assert answers.run_complaints(tmp_path, finished=False) == []
    assert answers.run_complaints(tmp_path, finished=True) == ["exit code 0, but there is no trajectory"]
    (tmp_path / "trajectory.vtkhdf").write_bytes(b"nothing")
    assert "does not open" in answers.run_complaints(tmp_path, finished=False)[0]
    trajectory_of(np.array([[0.3, 0.1], [0.3, 0.2]])).save(tmp_path / "trajectory.vtkhdf")
    (tmp_path / "scene.json").write_text(plane().to_json())
    assert answers.run_complaints(tmp_path, finished=True, steps=1) == []
    assert "2 frames, but 4" in answers.run_complaints(tmp_path, finished=True, steps=3)[0]
    (tmp_path / "metrics.jsonl").write_text('{"loss": NaN}\n')
    assert "not finite" in answers.search_complaints(tmp_path, finished=True)[0]
    (tmp_path / ".scene.json.3.tmp").touch()
    assert answers.leftovers(tmp_path) == [".scene.json.3.tmp"]


def test_the_bases_are_good(tmp_path):
    for tables in bases.scenes().values():
        scene = scene_from_dict(tables)
        assert sum(fluid.count(scene.discretisation.spacing) for fluid in scene.fluid) < 1500
    for tables in bases.tasks().values():
        (tmp_path / "task.toml").write_text(to_toml(tables))
        load_task(tmp_path / "task.toml")


def drawn(seed, number):
    """What a case is made of."""
    case = Case("scenes", number, seed, Path())
    tables = bases.tasks()["ensemble_search"]
    words = mutate(tables, list(bases.tasks().values()), case.random)
    text = mutate_text(to_toml(tables).encode("utf-8", "surrogatepass"), case.random)
    return words, text, override(case.random), option(case.random)


def test_a_case_repeats_from_its_seed_and_odd_values_and_hostile_files_are_made(tmp_path):
    assert all(drawn(1, number) == drawn(1, number) for number in range(40))
    assert drawn(1, 3) != drawn(1, 4) and drawn(1, 3) != drawn(2, 3)
    random = np.random.default_rng(0)
    for _ in range(300):
        to_toml({"x": oddities.value(random)})
    for tables in bases.tasks().values():
        assert tomllib.loads(to_toml(tables)) == tables
    good, made, random = tmp_path / "good.npy", set(), np.random.default_rng(0)
    np.save(good, np.zeros((64, 2)))
    for number in range(150):
        path = tmp_path / str(number) / "points.npy"
        path.parent.mkdir()
        made.add(make_hostile(path, good.read_bytes(), [b"others"], random))
    assert {"a shape beyond the file", "a pipe", "endless zeros", "cut", "of another format"} <= made
    odd = {'a "b"': [1, -2.5, "水\n\x7f", True, {"c d": []}], "inf": float("inf")}
    assert tomllib.loads(to_toml(odd)) == odd


def test_scripts_are_right():
    scripts = (shell_script(environment, "run", Path("kernels")) for environment in ENVIRONMENTS)
    subprocess.run(["bash", "-n", "-c", "\n".join(f"(\n{script}\n)" for script in scripts)], check=True)


def toy(case):
    """Complains of the case 2, and dies in the case 4."""
    with open(case.folder.parent.parent / "calls", "a") as file:
        file.write(f"{case.name} {case.random.integers(10**9)}\n")
    if case.number == 2:
        case.complaints.append("two")
    if case.number == 3:
        raise InputError("three")
    if case.number == 4:
        os._exit(3)


def test_a_campaign_goes_on_where_it_was_stopped(tmp_path, capfd):
    def campaign():
        return Campaign({"toy": Family(6, toy)}, seed=5, folder=tmp_path)

    first = campaign()
    first.run(first.open_cases()[:4], jobs=2)
    second = campaign()
    assert second.open_cases() == ["toy:4", "toy:5", "toy:2", "toy:3"]
    second.run(["toy:4", "toy:5"])
    assert campaign().open_cases(["toy"]) == ["toy:2", "toy:3", "toy:4"]
    assert "python -m fuzz --seed 5 --again toy:2" in capfd.readouterr().out
    calls = (tmp_path / "calls").read_text().splitlines()
    assert sorted(line.split()[0] for line in calls) == [f"toy:{number}" for number in range(6)]
    with open(tmp_path / "seed-5" / "ledger.jsonl", "ab") as file:
        file.write(b'{"case": "toy:9", "compl')  # torn by a kill
    third = campaign()
    third.run(["toy:1"])
    assert (tmp_path / "calls").read_text().splitlines()[-1] in calls  # the same random numbers
    third.run(["toy:1"], seconds=-1.0)
    assert len((tmp_path / "calls").read_text().splitlines()) == 7  # nothing begins after its time
    assert not third.case_folder("toy:1").exists() and third.case_folder("toy:2").exists()


def test_one_case_by_its_command(tmp_path):
    command = [sys.executable, "-m", "fuzz", "--seed", "1", "--again", "scenes:0", "--folder", str(tmp_path)]
    ended = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert ended.returncode in (0, 1) and "scenes" in ended.stdout, ended.stderr
    (line,) = (tmp_path / "seed-1" / "ledger.jsonl").read_text().splitlines()
    entry = json.loads(line)
    assert entry["case"] == "scenes:0" and not any("fuzzer itself" in words for words in entry["complaints"])
