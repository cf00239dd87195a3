"""Scenes as users write them: their tables, checked and frozen, their parameters, and their particles."""

from typing import TYPE_CHECKING

from cortado.lazy import getter

if not TYPE_CHECKING:
    __getattr__ = getter(__name__)
