"""Richardson extrapolation: what a number tends to as a scene is resolved more finely, and how fast."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import isclose, log

import numpy as np

LEAST, MOST = 1e-3, 20.0
"""Orders between which one is looked for."""
LOWEST, HIGHEST = 0.5, 2.0
"""Orders that are believed; the methods have 1 to 2. Values with another one are not in the range where differences
shrink by a power of the size."""
ROUND_OFF = 1e-6
"""Relative: an order that is one of both but for this is believed."""
SAFE, UNSURE = 1.25, 3.0
"""Safety factors of Roache (1994): of three sizes whose order is believed, and of all others."""


@dataclass(frozen=True)
class Extrapolation:
    """Of a number f(h) = limit + C h^order, from its values at the three finest sizes h.

    Source: L. F. Richardson, Phil. Trans. R. Soc. A 210 (1911), 307; the grid convergence index of P. J. Roache, J.
    Fluids Eng. 116 (1994), 405, by the procedure of I. B. Celik et al., J. Fluids Eng. 130 (2008), 078001, for sizes
    whose ratios differ. Where there is no order, the error is that of L. Eca and M. Hoekstra, J. Comput. Phys. 262
    (2014), 104: three times the greatest difference.
    """

    order: float | None
    """As observed; None where there is none."""
    limit: float | None
    """In the unit of the values, of the order within `LOWEST` and `HIGHEST` that is nearest to the observed one."""
    error: float | None
    """Of the value at the finest size, in its unit, with a safety factor: the limit is probably no further away. None
    of what is not a number."""
    flag: str = ""
    """Why no order is observed, or the observed one not believed, in words; empty in the asymptotic range."""

    @classmethod
    def of(cls, sizes: Sequence[float], values: Sequence[float]) -> "Extrapolation":
        """``values`` (k,) at ``sizes`` (k,), k of at least 3, the finest one last."""
        (h_3, h_2, h_1), (f_3, f_2, f_1) = sizes[-3:], values[-3:]
        fine, coarse = f_2 - f_1, f_3 - f_2
        if not np.isfinite([fine, coarse]).all():
            return cls(None, None, None, "not a number")
        widest = UNSURE * float(np.ptp([f_1, f_2, f_3]))
        if fine == 0.0:
            return cls(None, f_1, widest, "the two finest are equal")
        if fine * coarse < 0.0:
            return cls(None, None, widest, "it goes up and down")
        ratio, r_21, r_32 = coarse / fine, h_2 / h_1, h_3 / h_2
        if ratio <= log(r_32) / log(r_21):
            return cls(None, None, widest, "it does not come to rest")

        def excess(p: float) -> float:
            return float(r_21**p * (r_32**p - 1.0) / (r_21**p - 1.0) / ratio - 1.0)

        if excess(LEAST) * excess(MOST) > 0.0:
            return cls(None, None, widest, "it has no order that can be told")
        from scipy.optimize import brentq

        order = float(brentq(excess, LEAST, MOST, xtol=1e-12))
        used = min(max(order, LOWEST), HIGHEST)
        away, is_believed = fine / (r_21**used - 1.0), isclose(used, order, rel_tol=ROUND_OFF)
        flag = "" if is_believed else f"the order is taken as {used:g}"
        return cls(order, f_1 - away, (SAFE if is_believed else UNSURE) * abs(away), flag)
