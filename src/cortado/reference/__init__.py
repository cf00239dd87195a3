"""The reference engine: the same discretisation in C++ on the CPU, from float32 to float128, to judge gradients by.

It knows one phase, and five ways to a derivative: see `Simulation`. Nothing here imports Warp.
"""

from cortado.reference.digits import Digits
from cortado.reference.engine import EngineMissingError, available, precisions
from cortado.reference.histories import Gradient, History
from cortado.reference.losses import FinalPositions, Loss
from cortado.reference.simulation import METHODS, Simulation, Terms

__all__ = [
    "METHODS",
    "Digits",
    "EngineMissingError",
    "FinalPositions",
    "Gradient",
    "History",
    "Loss",
    "Simulation",
    "Terms",
    "available",
    "precisions",
]
