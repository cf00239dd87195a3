"""The C++ reference engine that checks gradients, from the separate package ``cortado-reference``."""

from cortado.calls import face
from cortado.errors import EngineMissingError

try:
    from cortado_reference import *  # noqa: F403
    from cortado_reference import __all__ as __all__
except ModuleNotFoundError as error:
    if error.name != "cortado_reference":
        raise
    raise EngineMissingError from None

__dir__ = face(globals())
