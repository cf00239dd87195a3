"""How free bodies are held: which ways they may go and turn."""

from dataclasses import dataclass
from typing import Self

from cortado.scene.courses import WAYS
from cortado.scene.solids import SolidTable

Three = tuple[float, float, float]


@dataclass(frozen=True)
class Hold:
    """How a free body is held. See `cortado.sph.held_bodies`."""

    moving: Three = (1.0, 1.0, 1.0)
    """1 along axes of space along which its middle may go, else 0."""
    turning: int = 3
    """Number of axes of space about which it may turn; 3 also in the plane where it turns."""
    axis: Three = (0.0, 0.0, 0.0)
    """Unit vector along the one axis about which it may turn, or along that about which it may not, if they are two."""
    arm: Three = (0.0, 0.0, 0.0)
    """From its centre of mass to its hinge, in its own frame [m]; 0 without a hinge."""

    @classmethod
    def of(cls, table: SolidTable, dimension: int) -> Self:
        """Return how the table of a free body holds it."""
        if table.freedom is None:
            return cls()
        free = [float(way in table.freedom) for way in WAYS[dimension]]
        x, y, z, *turns = (*free[:2], 0.0, *free[2:] * 3) if dimension == 2 else free
        turning = sum(map(int, turns))
        marked = [abs(turn - float(turning == 2)) for turn in turns]
        return cls((x, y, z), turning, (marked[0], marked[1], marked[2]))
