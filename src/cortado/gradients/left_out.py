"""Which runs of an ensemble an average leaves out, as they diverged."""

import warnings
from collections.abc import Sequence

import numpy as np

from cortado.errors import CortadoWarning, DivergedError
from cortado.gradients.estimator import Estimate

MOST = 0.25
"""Share of what is averaged that may be left out; with more the average would be that of another ensemble."""


def remaining(runs: Sequence[Estimate], members: int, what: str) -> np.ndarray:
    """(members,) whether each member of an ensemble can be averaged, given the runs of one member after the other. One
    run that diverged leaves its whole member out, so that those that remain are as symmetric about the parameters as
    before.

    ``what``: the members in words, in the plural. Warns of what is left out; raises the `DivergedError` of the first
    run that diverged where that is more than `MOST` of all.
    """
    errors = [getattr(one, "diverged", None) for one in runs]  # an estimator of one's own may return anything
    lost = np.array([error is not None for error in errors], dtype=bool).reshape(members, -1)
    kept = np.array([not any(member) for member in lost], dtype=bool)
    out = int(np.count_nonzero(~kept))
    if not out:
        return kept
    first = next(error for error in errors if error is not None)
    runs_lost = f"{np.count_nonzero(lost)} of {lost.size} runs of the ensemble diverged"
    said = f"{runs_lost}, by which {out} of {len(kept)} {what}"
    if out > MOST * len(kept):
        assert isinstance(first, DivergedError)
        raise first.among_others(
            f"{said} cannot be averaged, but at most a quarter may be left out: take a smaller spread. The first:"
        )
    warnings.warn(f"{said} are left out of the average. The first: {first}", CortadoWarning, stacklevel=3)
    return kept
