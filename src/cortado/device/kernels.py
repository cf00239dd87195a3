"""Families of kernels and of the functions that they are made of, typed."""

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Kernels:
    """A Warp kernel with its derivatives, or a Warp function with its."""

    forward: Any
    tangent: Any
    """Forward mode: from the tangents of the inputs, ``x_dot`` of an argument ``x``, to those of the outputs."""
    adjoint: Any
    """Reverse mode: adds to the adjoints of the inputs, ``x_bar``, what those of the outputs ask for."""


def kind_of(forward: bool, taped: bool) -> str:
    """What the name of a Warp module says of the kernels in it.

    Warp's own adjoint of forward kernels, which `gradients.Tape` needs, takes three times as long to compile as the
    kernels: those that a tape can differentiate are others, in modules of their own.
    """
    if not forward:
        return "derivative"
    return "taped" if taped else "forward"


def is_derivative(module: Any) -> bool:
    """Whether a Warp module has the kernels of derivatives."""
    return "_derivative_" in module.name or "_tangent_" in module.name
