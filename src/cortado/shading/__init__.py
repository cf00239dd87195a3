"""Pictures to show: shaded fluid on a floor, in its container of glass. `cortado.render` has those with derivatives."""

from typing import TYPE_CHECKING

from cortado.lazy import getter

if not TYPE_CHECKING:
    __getattr__ = getter(__name__)
