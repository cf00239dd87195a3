"""Pictures to aim at and files of pictures: `cortado.io.pictures` by the name that users have for it."""

from cortado.io.pictures import *  # noqa: F403
from cortado.io.pictures import __all__ as __all__
from cortado.io.pictures import __dir__ as __dir__
