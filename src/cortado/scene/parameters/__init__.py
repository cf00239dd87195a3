"""What a run depends on, by name: the list of all parameters, their values and checks, the way to a device and back."""

from typing import TYPE_CHECKING

from cortado.lazy import getter

if not TYPE_CHECKING:
    __getattr__ = getter(__name__)
