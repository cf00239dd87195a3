"""The speed of Cortado's solvers and of peers, in one run and in turn: ``python benchmarks/speed.py --sizes 125 8000``.

Prints milliseconds a step of each, and how many times as long it takes as the projection. A peer that is missing is a
line.
"""

import argparse
import json
import math
import os
import sys
import time
from typing import Any

from programs import Program, ProgramError, cortado, peers

from benchmarks.bench.environment import OtherProcesses

QUIET, LOOK = 0.2, 3.0
"""Cores that others keep busy at most on a quiet machine, and the seconds for which they are watched."""
Row = dict[str, Any]


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="The speed of Cortado and of its peers.")
    parser.add_argument("--sizes", type=int, nargs="+", default=[125, 1000, 8000, 97336], help="numbers of particles")
    parser.add_argument("--device", default="cpu", help='"cpu", or "cuda:0" for the first GPU')
    parser.add_argument("--precision", default="float32")
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--repeats", type=int, default=5, help="the median of so many counts")
    parser.add_argument("--rounds", type=int, default=1, help="turns of each program; the quietest round counts")
    parser.add_argument("--patience", type=float, default=0.0, help="seconds to wait for a quiet machine each time")
    parser.add_argument("--timeout", type=float, default=1200.0, help="seconds that a program may take")
    parser.add_argument("--jax-python", default=sys.executable, help="an interpreter that has jax")
    parser.add_argument("--splishsplash-python", default=sys.executable, help="one that has pysplishsplash")
    parser.add_argument("--no-peers", action="store_true", help="Cortado alone")
    parser.add_argument("--json", action="store_true", help="print all that was measured, also each pass of a step")
    return parser.parse_args()


def measure_size(programs: list[Program], particles: int, given: argparse.Namespace) -> Row:
    """What every program measures at one size in the quietest round, and why one has measured nothing."""
    environment = {**os.environ, "JAX_PLATFORMS": "cpu" if given.device == "cpu" else "cuda"}  # and no other instead
    environment["XLA_PYTHON_CLIENT_PREALLOCATE"] = "false"  # so that the memory that JAX needs is seen
    rounds: list[dict[str, Row]] = []
    failed: dict[str, str] = {}
    for _ in range(given.rounds):
        rounds.append({})
        for program in programs:
            if program.name in failed:
                continue
            wait_for_quiet(given.patience)
            try:
                found = program.run(particles, given.steps, given.repeats, given.timeout, environment)
            except ProgramError as error:
                failed[program.name] = str(error)
            else:
                rounds[-1][program.name] = flat(found)
    return {"particles": particles, "measured": min(rounds, key=busiest), "failed": failed}


def busiest(measured: dict[str, Row]) -> float:
    """The most cores that other processes kept busy while one of the programs ran."""
    return max((row["cores_busy_elsewhere"] or 0.0 for row in measured.values()), default=math.inf)


def wait_for_quiet(patience: float) -> None:
    """Wait until other processes leave the cores alone, or until the patience [s] is at an end."""
    end = time.perf_counter() + patience
    while time.perf_counter() < end:
        others = OtherProcesses()
        time.sleep(LOOK)
        if (others.busy_cores() or 0.0) < QUIET:
            return


def flat(found: Row) -> Row:
    """What `python -m benchmarks bench` says of its only size and of the machine; what a peer says, as it is."""
    if "sizes" not in found:
        return found
    machine = {name: value for name, value in found.items() if name != "sizes"}
    return {**found["sizes"][0], **machine}


def table(size: Row) -> str:
    """The times of one size [ms a step], their ratios to the first program's, and what a gradient costs."""
    measured, counted = size["measured"], " {:>22}" * 3 + "{:>12}"
    lines = [
        f"{size['particles']:,} particles",
        f"{'':22}{counted.format('step alone', 'forward', 'gradient', 'bytes')}",
    ]
    first: Row = next(iter(measured.values()), {})
    for name, row in measured.items():
        times = [_time(row, first, what) for what in ("step", "rollout", "gradient")]
        used = row.get("memory", {}).get("gradient_bytes_per_particle")
        lines.append(f"{name:22}{counted.format(*times, '' if used is None else f'{used:,.0f}')}")
    return "\n".join([*lines, *(f"{name:22} failed: {why}" for name, why in size["failed"].items())])


def _time(row: Row, first: Row, what: str) -> str:
    """A time [ms] and its ratio to the first program's."""
    if what not in row:
        return "-"
    time = row[what]["ms"]
    return f"{time:.4g}" + (f" ({time / first[what]['ms']:.2f} x)" if what in first and row is not first else "")


def main() -> None:
    given = arguments()
    found = [] if given.no_peers else peers(given.device, given.jax_python, given.splishsplash_python)
    present = [program for program in found if program.is_installed]
    missing = [program.name for program in found if program not in present]
    programs = [*cortado(given.device, given.precision), *present]
    sizes = []
    for particles in given.sizes:
        sizes.append(measure_size(programs, particles, given))
        if not given.json:
            print(table(sizes[-1]), flush=True)
    if given.json:
        settings = {name: getattr(given, name) for name in ("device", "precision", "steps", "repeats", "rounds")}
        print(json.dumps({"settings": settings, "not_installed": missing, "sizes": sizes}, indent=1))
    else:
        busy = ", ".join(f"{busiest(size['measured']):.1f}" for size in sizes)
        print(f"cores that other processes kept busy, at each size: {busy}")
        for name in missing:
            print(f"not installed: {name}")


if __name__ == "__main__":
    main()
