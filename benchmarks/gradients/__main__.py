"""``python -m benchmarks.gradients``: computes what is missing of the leaderboard; with ``--table`` prints it."""

import argparse
import sys
from collections.abc import Sequence
from contextlib import nullcontext
from itertools import product
from pathlib import Path
from typing import Any

from benchmarks.bench.environment import environment
from cortado import CortadoError, InputError, __version__
from cortado.executors import InProcess, local_workers
from cortado.files.terminal import track

from .cells import HORIZONS, TRUTH, Bench, Cell
from .controls import CONTROLS
from .estimators import ESTIMATORS
from .losses import LOSSES
from .results import Results
from .scenes import SCENES
from .table import table
from .truth import DIRECTIONS, SAMPLES


def arguments(words: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.gradients", description=__doc__)
    parser.add_argument("results", type=Path, help="file of JSON lines; a command that was stopped goes on with it")
    for name, registry in (("scenes", SCENES), ("controls", CONTROLS), ("losses", LOSSES), ("estimators", ESTIMATORS)):
        known = list(registry)
        parser.add_argument(f"--{name}", nargs="+", choices=known, default=known, metavar="NAME", help=", ".join(known))
    parser.add_argument("--horizons", type=int, nargs="+", default=list(HORIZONS), help="numbers of steps")
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(8)), help="of places and hidden runs")
    parser.add_argument("--device", default="cpu", help='"cpu", or "cuda:0" for the first GPU')
    parser.add_argument("--precision", default="float64", choices=("float32", "float64"))
    parser.add_argument("--workers", type=int, help="processes, on a GPU each with one of its own")
    parser.add_argument("--table", action="store_true", help="print what the file has, and compute nothing")
    return parser.parse_args(words)


def chosen(given: argparse.Namespace) -> list[Cell]:
    """The cells that are asked for, short runs first."""
    questions = product(sorted(given.horizons), given.scenes, given.controls, given.losses, given.seeds)
    return [
        Cell(scene, control, loss, horizon, seed, estimator)
        for horizon, scene, control, loss, seed in questions
        for estimator in (TRUTH, *given.estimators)
    ]


def compute(given: argparse.Namespace, results: Results) -> None:
    """Compute the cells that the file lacks, and write each as it arrives."""
    bench = Bench(given.device, given.precision)
    settings = {"cortado": __version__, "device": given.device, "precision": given.precision}
    cells = [cell for cell in chosen(given) if cell not in results.records and bench.fits(cell)]
    kind = given.device.partition(":")[0]
    with (
        results.adding({**settings, "samples": SAMPLES, "directions": DIRECTIONS}, environment()) as add,
        nullcontext(InProcess()) if given.workers is None else local_workers(given.workers, kind) as executor,
        track(sum(cell.horizon for cell in cells), "steps") as advance,
    ):

        def keep(number: int, record: dict[str, Any]) -> None:
            add(record)
            advance(cells[number].horizon)

        executor.map(bench, cells, keep)


def main(words: Sequence[str] | None = None) -> int:
    """Returns the exit code: 2 where what is asked for is wrong, 1 where it cannot be computed."""
    given = arguments(words)
    try:
        if min(given.horizons) < 1 or min(given.seeds) < 0:
            raise InputError("horizons must be at least 1 and seeds at least 0.")
        results = Results(given.results)
        if not given.table:
            compute(given, results)
        print(table(results.records.values()))
    except CortadoError as error:
        print(error, file=sys.stderr)
        return 2 if isinstance(error, InputError) else 1
    except KeyboardInterrupt:
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
