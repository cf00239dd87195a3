"""The version of Cortado, of which `cortado.__version__` is the public name."""

__version__ = "0.2.0"
