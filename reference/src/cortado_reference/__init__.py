"""The reference engine: the same discretisation in C++ on the CPU, from float32 to float128, to judge gradients by.

It knows one phase, and five ways to a derivative: see `Simulation`. Nothing here imports Warp.
"""

from cortado_reference.digits import Digits
from cortado_reference.engine import precisions
from cortado_reference.histories import Gradient, History
from cortado_reference.losses import FinalPositions, Loss
from cortado_reference.simulation import METHODS, Simulation, Terms

__version__ = "0.2.0"

__all__ = [
    "METHODS",
    "Digits",
    "FinalPositions",
    "Gradient",
    "History",
    "Loss",
    "Simulation",
    "Terms",
    "precisions",
]
