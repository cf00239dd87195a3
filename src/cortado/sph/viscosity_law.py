"""How the viscosity of a fluid follows from its shear rate: a function of one's own, or that of a Newtonian fluid."""

import inspect
from dataclasses import dataclass
from functools import cache
from typing import Any

from cortado.device.precision import Precision
from cortado.sph.formula import Formula, formula
from cortado.sph.formula_kernels import applied
from cortado.sph.function_source import plain_function


@dataclass(frozen=True)
class Law:
    """A law of viscosity, with the ranks of its parameters: 0 of numbers."""

    text: Formula
    ranks: tuple[int, ...]
    topic: str
    """Tells the Warp modules of one law from those of others; empty for Newtonian fluids."""

    @property
    def is_newtonian(self) -> bool:
        """Whether the viscosity does not depend on the shear rate."""
        return not self.topic

    def applied(self, precision: Precision, module: Any) -> Any:
        """The Warp function of the shear rate [1/s], of the viscosity that particles have [Pa s], and of theta: the
        viscosity [Pa s]."""
        return applied(self.text, precision, self.ranks, 3, module)


def newtonian(shear_rate, viscosity):
    """The viscosity does not depend on the shear rate."""
    return viscosity


@cache
def newtonian_law() -> Law:
    """That of fluids without another one."""
    return Law(formula("Rheology", plain_function("Rheology", newtonian), inspect.getsource(newtonian), {})[0], (), "")
