"""What every case needs, imported once: a fork of this process then starts at once."""

import importlib
import os
import sys

MODULES = (
    "av",
    "h5py",
    "matplotlib.backends.backend_agg",
    "matplotlib.figure",
    "scipy.spatial",
    "cortado.__main__",
    "cortado.cli",
    "cortado.commands.optimise",
    "cortado.commands.run",
    "cortado.study.experiment_files",
)


def warm() -> None:
    """Import Cortado and start Warp, but launch no kernel, so that this process can be forked."""
    import warp as wp

    wp.config.log_level = wp.LOG_ERROR
    sys.stderr.flush()
    stderr, nothing = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nothing, 2)  # C code says there that it has found no driver of a GPU
    wp.init()
    os.dup2(stderr, 2)
    os.close(stderr)
    os.close(nothing)
    for module in MODULES:
        importlib.import_module(module)
