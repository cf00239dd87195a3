"""Control tasks: ``python -m benchmarks.control --task carry --contender adjoint_viscosity cma_es``; README.md.

Every contender searches the controls of every task once for each seed. Runs are lines of a file; those that are there
are skipped. ``--figures`` draws curves of the loss over simulated steps, and the last pictures of what was found.
"""

import argparse
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path

from cortado.errors import CortadoError, InputError
from cortado.files.disk import locked
from cortado.files.terminal import track

from .catalogue import SIZES, TASKS, task
from .contenders import CONTENDERS, contender
from .curves import draw, medians, reached
from .records import Record, Records, Run, outcome

BUDGETS = {"small": 20_000.0, "large": 200_000.0}
"""Simulated steps of a search, by size."""


def arguments(given: Sequence[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.control", description="Control tasks, and what searches their controls."
    )
    parser.add_argument("--task", nargs="+", default=list(TASKS), metavar="TASK", help=", ".join(TASKS))
    parser.add_argument("--contender", nargs="+", default=list(CONTENDERS), metavar="NAME", help=", ".join(CONTENDERS))
    parser.add_argument("--size", choices=SIZES, default="small")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3, 4, 5], help="of first positions and searches")
    parser.add_argument("--budget", type=float, help="simulated steps of a search; 20,000 of a small task, or 200,000")
    parser.add_argument("--device", default="cpu", help='"cpu", or "cuda:0" for the first GPU')
    parser.add_argument("--precision", default="float32")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("runs/control"), help="folder of runs.jsonl and figures")
    parser.add_argument("--figures", action="store_true", help="draw what is there, and run nothing")
    return parser.parse_args(given)


def compute(runs: list[Run], records: Records, processes: int) -> bool:
    """Carry out what is missing; whether all of it could be."""
    missing, failed = records.missing(runs), []
    print(f"{len(runs) - len(missing)} of {len(runs)} runs are in {records.path}.")
    with track(len(missing), "runs") as advance:
        for run, found in outcomes(missing, processes):
            if isinstance(found, Record):
                records.add(found)
            else:
                failed.append(f"{run.task}, {run.contender}, seed {run.seed}: {found}")
            advance()
    print(*failed, sep="\n", end="\n" if failed else "", file=sys.stderr)
    return not failed


def outcomes(runs: list[Run], processes: int):
    """Each run and what came of it, in the order in which they end: a record, or why there is none."""
    if processes == 1:
        yield from ((run, outcome(run)) for run in runs)
        return
    with ProcessPoolExecutor(processes, get_context("spawn")) as pool:
        waiting = {pool.submit(outcome, run): run for run in runs}
        for done in as_completed(waiting):
            yield waiting[done], done.result()


def main(given: Sequence[str] | None = None) -> int:
    """See the head of the file; returns the exit code."""
    asked = arguments(given)
    records = Records(asked.out / "runs.jsonl")
    try:
        for name in asked.contender:
            contender(name)
        for name in asked.task:
            task(name, asked.size)
        if asked.processes < 1:
            raise InputError(f"--processes is {asked.processes}, but must be at least 1.")
        budget = BUDGETS[asked.size] if asked.budget is None else asked.budget
        runs = [
            Run(name, asked.size, who, seed, budget, asked.device, asked.precision)
            for seed in asked.seeds
            for name in asked.task
            for who in asked.contender
        ]
        if not asked.figures:
            with locked(asked.out):
                return 0 if compute(runs, records, asked.processes) else 1
        found = [record for record in records.read() if record.run in runs]
        for name in asked.task:
            draw(name, asked.size, [record for record in found if record.run.task == name], asked.out)
        print(medians(found), reached(found), sep="\n\n")
        return 0
    except CortadoError as error:
        print(error, file=sys.stderr)
        return 2 if isinstance(error, InputError) else 1


if __name__ == "__main__":
    sys.exit(main())
