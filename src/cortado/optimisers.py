"""Optimisers for `cortado.optimise`."""

from cortado.optimisation.optimisers import *  # noqa: F403
from cortado.optimisation.optimisers import __all__ as __all__
from cortado.optimisation.optimisers import __dir__ as __dir__
