"""Pictures of a run. Every function draws one PNG, 1200 pixels wide or more, and returns its path."""

from cortado.pictures.canvas import PALETTE
from cortado.pictures.curves import loss_curve
from cortado.pictures.panels import panels
from cortado.pictures.particle_sets import particles
from cortado.pictures.side_by_side import images

__all__ = ["PALETTE", "images", "loss_curve", "panels", "particles"]
