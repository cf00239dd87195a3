"""What is said on stderr where kernels are compiled for the first time, and how programs compile them fast."""

import re

import warp as wp

from cortado.device.kernels import is_derivative

UNOPTIMISED = "import warp as wp; wp.config.optimization_level = 0\n"
"""First line of a program of which it matters what it compiles, and when, but not how fast kernels are then: compiling
takes half as long, and the numbers have the same bits."""
COMPILING = re.compile(r"Compiling (\d+ kernel modules for \w+|kernels), once on this machine(: [\d.]+ s|\.)\n")

LARGE = ("projection", "viscous_stress", "surface_curvature", "implicit_step")
"""What the names of modules begin with whose derivatives take long to compile for how often tests launch them. Others
are launched so often that they would cost more time than is saved, such as those of PCISPH in three dimensions."""


def leave_large_derivatives_unoptimised():
    """From now on LLVM compiles these derivatives as they are written, in a third of the time. The level is part of a
    module's name in the cache, so that those which users have are others."""
    get_module = wp.get_module
    names = tuple(f"cortado_{topic}_" for topic in LARGE)

    def unoptimised(name):
        module = get_module(name)
        if name.startswith(names) and is_derivative(module):
            module.options["optimization_level"] = 0
        return module

    wp.get_module = unoptimised


def without_compiling(err):
    """What stderr would have if all kernels came from the cache, for tests that may be the first to need one."""
    return "".join(line for line in err.splitlines(keepends=True) if not COMPILING.fullmatch(line))
