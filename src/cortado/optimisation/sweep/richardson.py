"""Richardson extrapolation: what a number tends to as a scene is resolved more finely, and how fast."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import log

import numpy as np

LEAST, MOST = 1e-3, 20.0
"""Orders between which one is looked for."""


@dataclass(frozen=True)
class Extrapolation:
    """Of a number f(h) = limit + C h^order, from its values at the three finest sizes h.

    Source: L. F. Richardson, Phil. Trans. R. Soc. A 210 (1911), 307; for sizes whose ratios differ I. B. Celik et al.,
    J. Fluids Eng. 130 (2008), 078001, which solve the same equation.
    """

    order: float | None
    """None where there is none."""
    limit: float | None
    """In the unit of the values."""
    why: str = ""
    """Why there is none, in words."""

    @classmethod
    def of(cls, sizes: Sequence[float], values: Sequence[float]) -> "Extrapolation":
        """``values`` (k,) at ``sizes`` (k,), k of at least 3, the finest one last."""
        (h_3, h_2, h_1), (f_3, f_2, f_1) = sizes[-3:], values[-3:]
        fine, coarse = f_2 - f_1, f_3 - f_2
        if not np.isfinite([fine, coarse]).all():
            return cls(None, None, "not a number")
        if fine == 0.0:
            return cls(None, f_1, "the two finest are equal")
        if fine * coarse <= 0.0:
            return cls(None, None, "it goes up and down")
        ratio, r_21, r_32 = coarse / fine, h_2 / h_1, h_3 / h_2
        if ratio <= log(r_32) / log(r_21):
            return cls(None, None, "it does not come to rest")

        def excess(p: float) -> float:
            return float(r_21**p * (r_32**p - 1.0) / (r_21**p - 1.0) / ratio - 1.0)

        if excess(LEAST) * excess(MOST) > 0.0:
            return cls(None, None, "it has no order that can be told")
        from scipy.optimize import brentq

        order = float(brentq(excess, LEAST, MOST, xtol=1e-12))
        return cls(order, f_1 - fine / (r_21**order - 1.0))
