"""Distances of pictures, for `losses.Image`: `cortado.losses.image_losses` by the name that users have for it."""

from cortado.losses.image_losses import *  # noqa: F403
from cortado.losses.image_losses import __all__ as __all__
from cortado.losses.image_losses import __dir__ as __dir__
