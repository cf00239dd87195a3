"""The Warp modules that kernels are compiled in.

For a CPU LLVM finds what can be done four numbers at a time in loops over neighbours, which take `UNROLL` of them at
once (`cortado.particles.neighbourhood`), if it looks deep enough: with Warp's depth of 4 a step of the projection takes
a fifth longer, one of PCISPH a twentieth, and both have the same bits. With LLVM's own depth of 12 the density takes a
fifth longer than with 7.
"""

from dataclasses import dataclass
from typing import Any

import warp as wp

SHALLOW, DEEP = "-slp-recursion-max-depth=4", "-slp-recursion-max-depth=7"
"""An option of LLVM, as Warp gives it and as it is for our modules. Other flags are those of Warp's configuration."""
UNUSED = "-DWP_NO_BFLOAT16="
"""Leaves the functions of bfloat16 numbers out of Warp's headers, which take 1.0 s of a core of 2.5 GHz then to be
precompiled, and not 1.7 s."""


def kernel_module(name: str, backward: bool = False) -> Any:
    """The Warp module cortado_``name``. Its kernels get Warp's own adjoint, or do without."""
    module = wp.get_module(f"cortado_{name}")
    module.options["enable_backward"] = backward
    flags = wp.config.cpu_compiler_flags
    module.options["cpu_compiler_flags"] = flags and flags.replace(SHALLOW, f"{DEEP} {UNUSED}")
    return module


@dataclass(frozen=True)
class Kernels:
    """A Warp kernel, or a Warp function, with its derivatives in both modes."""

    forward: Any
    tangent: Any
    """Forward mode: from the tangents of the inputs, ``x_dot`` of an argument ``x``, to those of the outputs."""
    adjoint: Any
    """Reverse mode: from the adjoints of the outputs, adds to the adjoints of the inputs, ``x_bar``."""


def kind_of(forward: bool, taped: bool) -> str:
    """The part of the name of a Warp module that says which kernels it has: "forward", "taped" or "derivative".

    Warp's own adjoint of forward kernels, which `gradients.Tape` needs, takes three times as long to compile as the
    kernels: those that a tape can differentiate are others, in modules of their own.
    """
    if not forward:
        return "derivative"
    return "taped" if taped else "forward"


def is_derivative(module: Any) -> bool:
    """Whether the kernels of a Warp module are derivatives."""
    return "_derivative_" in module.name or "_tangent_" in module.name
