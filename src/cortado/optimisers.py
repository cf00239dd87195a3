"""Optimisers, for `cortado.optimise`: `cortado.optimisation.optimisers` by the name that users have for it."""

from cortado.optimisation.optimisers import *  # noqa: F403
from cortado.optimisation.optimisers import __all__ as __all__
from cortado.optimisation.optimisers import __dir__ as __dir__
