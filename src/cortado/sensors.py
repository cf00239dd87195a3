"""What a gauge would read in the fluid: pressure at a point, the height of its surface, a flow, the load on a solid."""

from cortado.runs.sensors import *  # noqa: F403
from cortado.runs.sensors import __all__ as __all__
from cortado.runs.sensors import __dir__ as __dir__
