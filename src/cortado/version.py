"""The version of Cortado; its public name is `cortado.__version__`."""

__version__ = "0.2.0"
