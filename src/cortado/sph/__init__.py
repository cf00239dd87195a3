"""The physical terms of a step, each with its kernels, their launches and the parameters that it depends on."""

from typing import TYPE_CHECKING

from cortado.lazy import getter

if not TYPE_CHECKING:
    __getattr__ = getter(__name__)
