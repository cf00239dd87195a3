"""What runs on a device: precisions, launches, cells, neighbours, states; Warp, its cache and its threads."""

from typing import TYPE_CHECKING

from cortado.lazy import getter

if not TYPE_CHECKING:
    __getattr__ = getter(__name__)
