"""Edges of triangles, and whether triangles close there."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cortado.discretise.shapes import Points
from cortado.discretise.solids.triangle_tree import Numbers
from cortado.errors import InputError


@dataclass(frozen=True)
class Edges:
    """The edges of triangles that share vertices."""

    ends: Numbers
    """(e, 2) their vertices, the lower number first"""
    names: Numbers
    """(k, 3) which edge each side of a triangle is"""
    ways: Numbers
    """(k, 3) 1 where a triangle goes along it from the lower number to the higher, -1 where it goes back"""

    @classmethod
    def of(cls, triangles: Numbers) -> "Edges":
        """Those of triangles (k, 3)."""
        sides = np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=-1)
        ends = np.sort(sides, axis=-1)
        span = int(triangles.max(initial=0)) + 1
        keys, names = np.unique(ends[..., 0] * span + ends[..., 1], return_inverse=True)
        ways = np.where(sides[..., 0] < sides[..., 1], 1, -1)
        return cls(np.column_stack([keys // span, keys % span]), names.reshape(-1, 3), ways)

    @property
    def counts(self) -> Numbers:
        """(e,) how many triangles meet at each edge."""
        return np.bincount(self.names.ravel(), minlength=len(self.ends))

    def close(self) -> NDArray[np.bool_]:
        """(e,) whether as many triangles go along an edge one way as the other."""
        return np.asarray(np.bincount(self.names.ravel(), self.ways.ravel(), len(self.ends)) == 0.0)

    def check(self, vertices: Points, what: str) -> None:
        """Raises `InputError`, a sentence that calls the mesh ``what``, where the triangles do not close."""
        unbalanced, counts = ~self.close(), self.counts
        several, alone = unbalanced & (counts > 2), counts == 1
        if several.any():
            raise InputError(
                f"{what} has {many(several.sum(), 'edge')} at which three triangles or more meet without closing, the "
                f"first at {self._first(several, vertices)}, so that nothing says what is inside: delete faces that "
                "divide its inside or stick out of it."
            )
        if alone.any():
            raise InputError(
                f"{what} is not closed, so that nothing says what is inside: it has {many(alone.sum(), 'open edge')}, "
                f"the first at {self._first(alone, vertices)}; close its holes, small ones by trimesh's "
                "mesh.fill_holes(), and give a sheet a thickness."
            )
        if unbalanced.any():
            raise InputError(
                f"Normals of {what} point inwards at some triangles and outwards at others: they change at "
                f"{many(unbalanced.sum(), 'edge')}, the first at {self._first(unbalanced, vertices)}; let all point "
                "outwards, as trimesh's mesh.fix_normals() does."
            )

    def _first(self, which: NDArray[np.bool_], vertices: Points) -> str:
        return self.place(int(np.argmax(which)), vertices)

    def place(self, edge: int, vertices: Points) -> str:
        """The middle of one of them, in words."""
        return place_in_file(vertices[self.ends[edge]].mean(axis=0))


def place_in_file(place: Points) -> str:
    """A point in words, for a sentence."""
    return f"({', '.join(f'{value:.7g}' for value in place)}) in the file"


def many(count: int, one: str, several: str = "") -> str:
    """So many things, in words."""
    return f"{count} {one if count == 1 else several or f'{one}s'}"
