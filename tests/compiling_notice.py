"""What is said on stderr where kernels are compiled for the first time, and how programs compile them fast."""

import re
from inspect import getsource

from cortado.device.modules import UNUSED

UNOPTIMISED = "import warp as wp; wp.config.optimization_level = 0\n"
"""First line of a program of which it matters what it compiles, and when, but not how fast kernels are then: compiling
takes half as long, and the numbers have the same bits."""
FLAGS = f"-march=native {UNUSED}"
"""LLVM's own limits of inlining: kernels compile in two thirds of the time, and long gradients take a fifth more.
Without functions of bfloat16 a module takes 0.05 s less, and its first in a process 0.7 s less."""


def compile_fast(flags):
    """Kernels are compiled with these flags, and as they are written, in a third of the time, if they run for next to
    nothing: derivatives of modules that are named after no smoothing kernel, so without sums over neighbours, and those
    that Warp makes for a tape. Bodies look for their contacts by all their points in every step."""
    import re

    import warp as wp

    wp.config.cpu_compiler_flags, get_module = flags, wp.get_module

    def unoptimised(name):
        module = get_module(name)
        if "contacts" not in name and re.search(r"_taped|_(derivative|tangent)(_\d+)?_float\d+$", name):
            module.options["optimization_level"] = 0
        return module

    wp.get_module = unoptimised


SAME_KERNELS = f"{getsource(compile_fast)}\n\ncompile_fast({FLAGS!r})\n"
"""First lines of a program whose kernels are those of the tests, so that they are compiled once."""
COMPILING = re.compile(r"Compiling (\d+ kernel modules for \w+|kernels), each once on this machine(: [\d.]+ s|\.)\n")


def without_compiling(err):
    """What stderr would have if all kernels came from the cache, for tests that may be the first to need one."""
    return "".join(line for line in err.splitlines(keepends=True) if not COMPILING.fullmatch(line))
