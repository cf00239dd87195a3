"""What a certificate found, as tables and sentences."""

from collections.abc import Mapping, Sequence
from io import StringIO
from math import log10
from typing import Any

from cortado.certificate.agreement import Agreement
from cortado.certificate.horizon import Horizon
from cortado.certificate.rightness import Comparison

WIDTH = 110
"""Characters of a table at most."""


def parameter_table(shares: Mapping[str, float], wrong: Sequence[str]) -> str:
    """How much each parameter changes the loss, and whether its derivative is right."""
    verdicts = {name: "WRONG" if name in wrong else "right" for name in shares}
    rows = [
        [name, f"{share:.3e}", verdicts[name] if share or name in wrong else "not felt by this loss"]
        for name, share in shares.items()
    ]
    return _table(["parameter", "a change of it changes the loss by", "adjoint"], rows)


def agreement_words(comparison: Comparison) -> str:
    """To how many digits the ways to the derivative agree."""
    digits = f"reverse and forward mode agree to {_digits(comparison.disagreement)} digits"
    if comparison.miss is None:
        return f"{digits}, no difference is reliable here"
    return f"{digits}, with differences to {_digits(comparison.miss)}, up to step {comparison.last_believed}"


def horizon_table(horizons: Sequence[Horizon]) -> str:
    """Up to which step each exact derivative means something."""
    rows = [
        [
            horizon.parameter,
            "later" if horizon.predicted is None else f"step {horizon.predicted}",
            f"step {horizon.measured}" + (", the last" if horizon.lasts else ""),
        ]
        for horizon in horizons
    ]
    return _table(["parameter", "predicted horizon", "measured horizon"], rows)


def gradient_table(agreement: Agreement) -> str:
    """How near each gradient is to that of the smoothed loss."""
    rows = [[judged.estimator, f"{judged.cosine:.3f}", f"{judged.size:.3g}"] for judged in agreement.estimators]
    return (
        f"{_table(['estimator', 'cosine', 'size'], rows)}\n"
        f"to the gradient of the smoothed loss, whose own error is {agreement.noise:.0%}"
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
    Console(file=text, width=WIDTH).print(table)
    return text.getvalue().rstrip()
