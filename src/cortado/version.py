"""The version of Cortado."""

__version__ = "0.2.0"
