"""Where independent work is computed, such as the members of an ensemble; see `docs/many_machines.md`."""

from cortado.device.executors import *  # noqa: F403
from cortado.device.executors import __all__ as __all__
from cortado.device.executors import __dir__ as __dir__
