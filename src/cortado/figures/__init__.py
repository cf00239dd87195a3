"""Pictures of a run. Every function draws one PNG, 1200 pixels wide or more, and returns its path."""

from cortado.figures.canvas import PALETTE
from cortado.figures.curves import curve, loss_curve, parameters
from cortado.figures.panels import panels
from cortado.figures.particle_sets import particles
from cortado.figures.side_by_side import images

__all__ = ["PALETTE", "curve", "images", "loss_curve", "panels", "parameters", "particles"]
