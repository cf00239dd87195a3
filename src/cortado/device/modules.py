"""The Warp modules that kernels are compiled in, before they are launched: all that a step needs, side by side, and one
line says so.

On a CPU, LLVM vectorises loops over neighbours, four numbers at a time, if it looks deep enough. These loops take
`UNROLL` neighbours at once (`cortado.particles.neighbourhood`). With Warp's depth of 4 a step of the projection takes a
fifth longer and a step of PCISPH a twentieth, with the same bits. With LLVM's own depth of 12 the density takes a fifth
longer than with 7.

Warp compiles a module when the first of its kernels is launched, one module after the other. `wp.force_load` of all of
them with workers of its own is as fast as what is done here. But after Ctrl-C it waits for all of them, and of a few at
a time it takes 1.7 times as long.
"""

import os
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, wait
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from weakref import WeakValueDictionary

import warp as wp

from cortado.device.threads import MOST_CORES, helpers, in_parallel, usable_cores
from cortado.files.terminal import note, timed_note

SHALLOW, DEEP = "-slp-recursion-max-depth=4", "-slp-recursion-max-depth=7"
"""An option of LLVM, as Warp gives it and as it is for our modules. Other flags are those of Warp's configuration."""
UNUSED = "-DWP_NO_BFLOAT16="
"""Compiler flag that leaves bfloat16 functions out of Warp's headers, whose precompilation takes 1.0 s then instead of
1.7 s on a 2.5 GHz core."""


def kernel_module(name: str, backward: bool = False) -> Any:
    """Return the Warp module cortado_``name``, whose kernels have Warp's own adjoint only if ``backward``."""
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
    """Kernel of forward mode: from tangents of the inputs, ``x_dot`` of an argument ``x``, to those of the outputs."""
    adjoint: Any
    """Kernel of reverse mode: from adjoints of the outputs, adds to those of the inputs, ``x_bar``."""


def by_name(*made: Any) -> SimpleNamespace:
    """Return Warp functions or kernels as attributes, by the names of their Python functions."""
    return SimpleNamespace(**{one.func.__name__.rpartition("__")[2]: one for one in made})


def kind_of(forward: bool, taped: bool) -> str:
    """Return the part of a Warp module's name that tells its kernels: "forward", "taped" or "derivative".

    Warp's own adjoint of forward kernels, which `gradients.Tape` needs, takes three times as long to compile as the
    kernels: those that a tape can differentiate are others, in modules of their own.
    """
    if not forward:
        return "derivative"
    return "taped" if taped else "forward"


def is_derivative(module: Any) -> bool:
    """Test if the kernels of a Warp module are derivatives."""
    return "_derivative_" in module.name or "_tangent_" in module.name


_ahead: WeakValueDictionary[int, Any] = WeakValueDictionary()
"""Objects, by identity, whose kernels were compiled ahead."""
_begun: dict[Any, Future[None]] = {}
"""Futures of modules that another thread compiles or has compiled, and that nobody has awaited yet."""
_looked_at: set[Any] = set()
"""Modules of kernels that were launched."""


class _Said:
    """A flag of this process that compiling has been announced."""

    anything = False


def compile_ahead(owner: Any, device: Any) -> None:
    """Compile the modules of all kernels but derivatives that an object holds, directly or in its parts, before a
    solver's step launches them. Once for each object; cached modules are loaded at their launch."""
    if _ahead.get(id(owner)) is not owner:
        _ahead[id(owner)] = owner
        _compile([kernel for kernel in kernels_of(owner) if not is_derivative(kernel.module)], device)


def compile_ahead_adjoint(owner: Any, device: Any) -> None:
    """Compile an object's kernels and adjoints before a backward step launches them; see `compile_ahead`."""
    if _ahead.get(id(owner)) is not owner:
        _ahead[id(owner)] = owner
        _compile([kernel for kernel in kernels_of(owner) if "_tangent_" not in kernel.module.name], device)


def compile_meanwhile(owner: Any, device: Any) -> None:
    """Begin to compile an object's kernels in another thread, on a CPU with a spare core; `compile_ahead` waits for
    it."""
    if not device.is_cpu or usable_cores() < 2:
        return
    sizes = _sizes([kernel for kernel in kernels_of(owner) if not is_derivative(kernel.module)])
    missing = _missing({module: size for module, size in sizes.items() if module not in _begun}, device)
    if missing:
        _Said.anything = True  # or else a line would come of what nobody waits for
        _begun.update(dict.fromkeys(missing, helpers().submit(_compile_all, missing, device, 1)))


def announce(kernel: wp.Kernel, device: Any) -> None:
    """Print once a process on stderr that kernels are compiled, if a kernel about to be launched has to be."""
    module = kernel.module
    if module not in _looked_at:
        _looked_at.add(module)
        if not _Said.anything and module.name.startswith("cortado_") and not _is_compiled(module, device):
            _Said.anything = True
            note("Compiling kernels, once on this machine.")


def kernels_of(owner: Any) -> list[wp.Kernel]:
    """Return the kernels that an object of Cortado's holds, directly or in its parts."""
    found: dict[int, Any] = {}
    seen: dict[int, Any] = {}
    waiting = [owner]
    while waiting:
        one = waiting.pop()
        if id(one) in seen:
            continue
        seen[id(one)] = one
        if isinstance(one, wp.Kernel):
            found[id(one)] = one
        elif isinstance(one, (list, tuple, set, frozenset)):
            waiting += one
        elif isinstance(one, Mapping):
            waiting += one.values()
        elif isinstance(one, SimpleNamespace) or any(
            base.__module__.startswith("cortado.") for base in type(one).__mro__
        ):
            waiting += getattr(one, "__dict__", {}).values()
    return list(found.values())


def _compile(kernels: Sequence[wp.Kernel], device: Any) -> None:
    """Compile and load the kernels' modules that are not in the cache if there are several; a single one is left to its
    launch."""
    sizes = _sizes(kernels)
    wait([_begun.pop(module) for module in sizes if module in _begun])
    missing = _missing(sizes, device)
    if len(missing) < 2:
        return
    # For a GPU one after the other: NVRTC gains less from threads than it loses without its precompiled headers.
    cores = min(usable_cores(), MOST_CORES, len(missing)) if device.is_cpu else 1
    _Said.anything = True
    with timed_note(f"Compiling {len(missing)} kernel modules for {device.alias}, once on this machine"):
        _compile_all(missing, device, cores)


def _compile_all(modules: Sequence[Any], device: Any, cores: int) -> None:
    in_parallel(lambda module: wp.force_load(device, [module], max_workers=0), modules, cores)


def _sizes(kernels: Sequence[wp.Kernel]) -> dict[Any, int]:
    """Return the kernels' modules, each with a number that grows with its time to compile, which is long for sums over
    neighbours."""
    found: dict[Any, int] = {}
    for kernel in kernels:
        source = kernel.adj.source
        found[kernel.module] = found.get(kernel.module, 0) + len(source) * (10 if "s.first" in source else 1)
    return found


def _missing(sizes: Mapping[Any, int], device: Any) -> list[Any]:
    """Return the modules that have to be compiled, slowest first."""
    return sorted((module for module in sizes if not _is_compiled(module, device)), key=lambda one: -sizes[one])


def _is_compiled(module: Any, device: Any) -> bool:
    """Test if a module is loaded, or in the cache."""
    block_dim = 1 if device.is_cpu else module.options["block_dim"]
    if (device.context, block_dim) in module.execs:
        return True
    folder = Path(wp.config.kernel_cache_dir, module.get_module_identifier(block_dim))
    return (folder / module._get_compile_output_name(device, block_dim=block_dim)).exists()


if hasattr(os, "register_at_fork"):
    # A child would wait for ever for what no thread of its own ends.
    os.register_at_fork(before=lambda: wait(list(_begun.values())))
