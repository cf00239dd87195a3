"""The runs that a command line names: folders of runs, and folders of sweeps with all of their runs."""

from collections.abc import Sequence
from pathlib import Path

from cortado.errors import InputError
from cortado.optimisation.sweep import folders_in
from cortado.runs.run_folder import RunFolder


def named_runs(folders: Sequence[Path]) -> list[RunFolder]:
    """The runs that are meant, in each folder of a sweep all of them, in the order of its table. Raises `InputError`
    for a folder without a run."""
    if not folders:
        raise InputError("RUN is missing, but must be the folder of a run, or of a sweep.")
    found: list[RunFolder] = []
    for folder in folders:
        inner, order = sorted(one.parent for one in folder.glob("*/environment.json")), folders_in(folder)
        inner.sort(key=lambda one: order.index(one.name) if one.name in order else len(order))
        found += [RunFolder.open(one) for one in inner or [folder]]
    return found
