"""What every case needs, imported once: a fork of this process then starts at once."""

import importlib

from cortado.device.modules import init_warp

MODULES = (
    "av",
    "h5py",
    "matplotlib.backends.backend_agg",
    "matplotlib.figure",
    "scipy.spatial",
    "cortado.__main__",
    "cortado.cli",
    "cortado.cli.optimise",
    "cortado.cli.run",
    "experiments.experiment_files",
)


def warm() -> None:
    """Import Cortado and start Warp, but launch no kernel, so that this process can be forked."""
    init_warp()
    for module in MODULES:
        importlib.import_module(module)
