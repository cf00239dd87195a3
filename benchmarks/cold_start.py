"""Time from ``import cortado`` to the first step and the first gradient, with no compiled kernels: ``python
benchmarks/cold_start.py --device cpu``.

Every start is a process of its own with an empty folder for kernels (``WARP_CACHE_PATH``); ``--warm`` lets each scene
start once more with the kernels that are then there. ``--beside old=PATH`` measures another version of Cortado, the
folder that ``import cortado`` finds it in, in turn with this one, so that what else the machine does disturbs both.
"""

import argparse
import json
import os
import statistics
import sys
import tempfile
import time
from importlib.machinery import PathFinder
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve()
STAGES = ("import", "scene made", "first step", "first gradient")


def scene(name: str) -> dict[str, Any]:
    """A small block of fluid in a box: ``2-D`` or ``3-D``, with one phase or, where the name says so, two."""
    plane, several = name.startswith("2-D"), name.endswith("two phases")
    size = 2 if plane else 3

    def corner(*values: float) -> list[float]:
        return list(values[:size])

    names = ("water", "oil")[: 2 if several else 1]
    return {
        "dimension": size,
        "discretisation": {"spacing": 0.05},
        "phase": [
            {"name": phase, "rest_density": 1000.0 - 100.0 * k, "viscosity": 0.05} for k, phase in enumerate(names)
        ],
        "fluid": [
            {
                "shape": "box",
                "lower": corner(0.3 * k, 0.0, 0.0),
                "upper": corner(0.3 * (k + 1), 0.5, 0.5),
                "phase": phase,
            }
            for k, phase in enumerate(names)
        ],
        "container": {"shape": "box", "lower": corner(0.0, 0.0, 0.0), "upper": corner(1.0, 1.0, 0.5)},
        "solver": {"time_step": 0.002},
        **({"mixture": {"mobility": 1e-6}} if several else {}),
    }


SCENES = ("2-D, one phase", "3-D, one phase", "2-D, two phases", "3-D, two phases")


def start(name: str, device: str, precision: str) -> dict[str, Any]:
    """Go from the import to the first gradient in this process: seconds from the beginning, by the clock and of
    processor time, at the end of each stage, and the modules of kernels that were loaded until then."""
    begun, used = time.perf_counter(), time.process_time()
    stages: dict[str, Any] = {}
    modules: list[tuple[str, float]] = []

    def end(stage: str) -> None:
        stages[stage] = {
            "seconds": time.perf_counter() - begun,
            "processor_seconds": time.process_time() - used,
            "modules": {module: round(seconds, 3) for module, seconds in modules},
        }
        modules.clear()

    import cortado

    made = cortado.Simulation  # the import that a name of cortado's is found by
    end("import")
    note_modules(modules)
    simulation = made(cortado.Scene(**scene(name)), device=device, precision=precision)
    end("scene made")
    simulation.run(1)
    end("first step")
    problem = cortado.Problem(simulation, 1, cortado.losses.FinalPositions(simulation.positions + 0.01))
    problem.value_and_gradient({"gravity": simulation.scene.forces.gravity})
    end("first gradient")
    return {"stages": stages, "device": simulation.device.name}


class Sources:
    """Finds Cortado in a folder, before whatever an installation has put in the way."""

    def __init__(self, folder: str):
        self._folder = folder

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> Any:
        if name.partition(".")[0] != "cortado":
            return None
        return PathFinder.find_spec(name, [self._folder] if path is None else path, target)


def note_modules(modules: list[tuple[str, float]]) -> None:
    """Note the name of every module of kernels that Warp loads from now on, and the seconds that it took: by the clock
    of the thread that loads it, those that it waits for others included."""
    from warp._src.context import Module

    load = Module.load

    def noted(self: Any, device: Any, *arguments: Any, **options: Any) -> Any:
        begun, before = time.perf_counter(), len(self.execs)
        try:
            return load(self, device, *arguments, **options)
        finally:
            if len(self.execs) > before:
                modules.append((self.name, time.perf_counter() - begun))

    Module.load = noted


def measured(name: str, words: list[str], folder: str, sources: str | None) -> dict[str, Any]:
    """What `start` finds in a process of its own, with kernels in a folder; ends this one where that one fails."""
    from programs import ProgramError, last_json  # not in the process that is measured: it imports Cortado

    environment = {**os.environ, "WARP_CACHE_PATH": folder}
    where = ["--sources", sources] if sources is not None else []
    command = [sys.executable, str(HERE), "--one", "--scenes", name, *where, *words]
    try:
        found: dict[str, Any] = last_json(command, 600.0, environment)
    except ProgramError as error:
        sys.exit(f"{name}: {error}")
    return found


def median(runs: list[dict[str, Any]], stage: str, clock: str) -> float:
    return statistics.median(run["stages"][stage][clock] for run in runs)


def table(found: dict[str, list[dict[str, Any]]]) -> str:
    """Medians, as a table of Markdown: the clock at the end of each stage, and processor time at the end of two."""
    lines = [
        "| seconds since the import began | " + " | ".join(STAGES) + " | processor, step | processor, gradient | |"
    ]
    lines += ["|---|" + "---|" * (len(STAGES) + 3)]
    for label, runs in found.items():
        clocks = [median(runs, stage, "seconds") for stage in STAGES]
        used = [median(runs, stage, "processor_seconds") for stage in STAGES[2:]]
        count = sum(len(runs[0]["stages"][stage]["modules"]) for stage in STAGES[:3])
        cells = " | ".join(f"{seconds:.1f}" for seconds in (*clocks, *used))
        lines.append(f"| {label} | {cells} | {count} modules |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description="Time to the first step where no kernel is compiled yet.")
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), choices=SCENES)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--precision", default="float32")
    parser.add_argument("--rounds", type=int, default=3, help="starts of each scene, of which the median is shown")
    parser.add_argument("--beside", action="append", default=[], metavar="NAME=PATH", help="another version, in turn")
    parser.add_argument("--warm", action="store_true", help="also start with the kernels that a start has left")
    parser.add_argument("--modules", action="store_true", help="also list the modules that are loaded")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--one", action="store_true", help="one start of one scene, here and as JSON")
    parser.add_argument("--sources", help="where that one is to find Cortado")
    given = parser.parse_args()
    if given.one:
        if given.sources is not None:
            sys.meta_path.insert(0, Sources(given.sources))
        print(json.dumps(start(given.scenes[0], given.device, given.precision)))
        return
    versions: dict[str, str | None] = {**dict(entry.split("=", 1) for entry in given.beside), "this": None}
    words = ["--device", given.device, "--precision", given.precision]
    found: dict[str, list[dict[str, Any]]] = {}
    for name in given.scenes:
        for _ in range(given.rounds):
            for version, sources in versions.items():
                with tempfile.TemporaryDirectory() as folder:
                    for state in ("cold", "warm")[: 2 if given.warm else 1]:
                        run = measured(name, words, folder, sources)
                        parts = [name, *([version] if given.beside else []), *([state] if given.warm else [])]
                        found.setdefault(", ".join(parts), []).append(run)
    from benchmarks.bench.environment import environment

    around = environment()
    settings = {"device": given.device, "precision": given.precision, "rounds": given.rounds}
    if given.json:
        print(json.dumps({"environment": around, **settings, "starts": found}, indent=2))
        return
    print(table(found))
    for label, runs in found.items() if given.modules else ():
        print(label)
        for stage in STAGES:
            for module, seconds in runs[0]["stages"][stage]["modules"].items():
                print(f"    {stage}: {module} {seconds:.2f}")


if __name__ == "__main__":
    main()
