"""The results of a certificate as tables and sentences."""

from collections.abc import Collection, Mapping, Sequence
from io import StringIO
from math import log10
from typing import Any

from cortado.certificate.alignment import Alignment
from cortado.certificate.consistency import Consistency
from cortado.certificate.horizon import Horizon

WIDTH = 110
"""Characters of a table at most."""


def parameter_table(loss_changes: Mapping[str, float], wrong: Sequence[str], tried: Collection[str]) -> str:
    """By how much each parameter changes the loss, which is extrapolated but for those that were ``tried``, and whether
    its adjoint is right."""
    rows = []
    for name, share in loss_changes.items():
        verdict = "WRONG" if name in wrong else "right" if share else "no effect on this loss"
        rows.append([name, f"{share:.3e}" + (", extrapolated" if share and name not in tried else ""), verdict])
    return _table(["parameter", "slope times a perturbation", "adjoint"], rows)


def beyond_words(horizon: Horizon) -> str | None:
    """Up to which step there is an answer; None where it is the last one."""
    if horizon.reached == horizon.sample_steps[-1]:
        return None
    moved = f"a run that the perturbation of {horizon.parameter} moves"
    if horizon.reached == 0:
        return f"Of {horizon.parameter} there is no horizon: {moved} cannot begin, or loses a particle at once."
    return f"Beyond step {horizon.reached} there is no answer for {horizon.parameter}: {moved} loses a particle."


def consistency_words(c: Consistency, beside: Consistency | None = None) -> str:
    """To how many digits reverse mode, forward mode and central differences agree, and whether that is on a corner."""
    digits = f"reverse and forward mode agree to {_digits(c.disagreement)} digits"
    if c.miss is None:
        return f"{digits}, no difference is reliable here"
    slopes = f"on a corner of the loss: slopes of both sides differ by {100.0 * c.corner[c.converged][-1]:.2g} %"
    if beside is not None:
        return f"{digits}, {slopes}; beside it, {consistency_words(beside)}"
    found = f"{digits}, with differences to {_digits(c.miss)}, up to step {c.last_converged}"
    return f"{found} ({slopes})" if c.is_on_a_corner else found


def horizon_table(horizons: Sequence[Horizon]) -> str:
    """Up to which step the exact derivative with respect to each parameter is useful."""
    rows = [
        [
            horizon.parameter,
            "later" if horizon.predicted is None else f"step {horizon.predicted}",
            f"step {horizon.measured}" + (", the last" if horizon.lasts else ""),
        ]
        for horizon in horizons
    ]
    return _table(["parameter", "predicted horizon", "measured horizon"], rows)


def gradient_table(alignment: Alignment) -> str:
    """How well each estimator's gradient is aligned with that of the smoothed loss."""
    rows = [[judged.estimator, f"{judged.cosine:.3f}", f"{judged.size:.3g}"] for judged in alignment.estimators]
    return (
        f"{_table(['estimator', 'cosine', 'size'], rows)}\n"
        f"to the gradient of the smoothed loss, whose own error is {alignment.noise:.0%}"
    )


def _digits(distance: float) -> str:
    return f"{min(max(-log10(distance), 0.0), 16.0):.0f}" if distance > 0.0 else "16"


def _table(columns: list[str], rows: list[list[str]]) -> str:
    from rich.console import Console
    from rich.table import Table

    table: Any = Table(*columns)
    for row in rows:
        table.add_row(*row)
    text = StringIO()
    Console(file=text, width=WIDTH, force_jupyter=False).print(table)  # a notebook would show it elsewhere
    return text.getvalue().rstrip()
