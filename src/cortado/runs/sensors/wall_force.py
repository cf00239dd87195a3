"""The force of the fluid on walls."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cortado.errors import InputError
from cortado.fixed import fixed
from cortado.runs.sensors.sensor import Reading, corner, in_dimension, load_columns, point


@fixed
class WallForce:
    """The force with which the fluid pushes the walls, and its torque:

    F = sum_i f_i,   T = sum_i (x_i - about) x f_i,

    over the particles of a region, where f_i is the quantity "wall_force". Walls push the fluid with -F. The border of
    a region is a jump: let it run where particles do not push in the direction that is looked at, as half-way between
    two walls.
    """

    def __init__(self, lower: Any = None, upper: Any = None, about: Any = None):
        """``lower``, ``upper`` (d,) corners of the region [m], which has no end there if left out; ``about`` (d,) the
        point of the torque [m], the origin if left out."""
        self.lower, self.upper, self.about = (
            None if values is None else read(what, values)
            for what, values, read in (("lower", lower, corner), ("upper", upper, corner), ("about", about, point))
        )
        given = [values for values in (self.lower, self.upper, self.about) if values is not None]
        if len({len(values) for values in given}) > 1:
            raise InputError("lower, upper and about must have as many components as one another.")
        if self.lower is not None and self.upper is not None and not (self.lower < self.upper).all():
            raise InputError(f"upper is {self.upper.tolist()}, but must be greater than lower, {self.lower.tolist()}.")

    def __repr__(self) -> str:
        shown = (None if values is None else values.tolist() for values in (self.lower, self.upper, self.about))
        return f"WallForce({', '.join(map(str, shown))})"

    def columns(self, dimension: int) -> dict[str, str]:
        return load_columns(dimension)

    def value(self, at: Reading) -> NDArray[Any]:
        arms, force = self._chosen(at)
        torque = np.cross(_in_space(arms), _in_space(force)).sum(axis=0)
        return np.concatenate([force.sum(axis=0), torque if at.dimension == 3 else torque[2:]])

    def adjoint(self, at: Reading, bar: NDArray[Any]) -> dict[str, NDArray[Any]]:
        (arms, force), d = self._chosen(at), at.dimension
        torque_bar = bar[d:] if d == 3 else np.array([0.0, 0.0, bar[d]])
        _, inside = self._placed(at)
        return {
            "positions": np.cross(_in_space(force), torque_bar)[:, :d],
            "wall_force": np.where(inside[:, None], bar[:d] + np.cross(torque_bar, _in_space(arms))[:, :d], 0.0),
        }

    def _chosen(self, at: Reading) -> tuple[NDArray[Any], NDArray[Any]]:
        """(n, d) the arms of the particles, and their forces, 0 outside of the region."""
        about = np.zeros(at.dimension) if self.about is None else in_dimension("about", self.about, at.dimension)
        places, inside = self._placed(at)
        return places - about, np.where(inside[:, None], at["wall_force"], 0.0)

    def _placed(self, at: Reading) -> tuple[NDArray[Any], NDArray[Any]]:
        """(n, d) the images of the particles that may be in the region [m], and whether they are (n,)."""
        lower, upper = (
            np.full(at.dimension, end) if values is None else in_dimension(what, values, at.dimension)
            for what, values, end in (("lower", self.lower, -np.inf), ("upper", self.upper, np.inf))
        )
        return at.lattice.domain.within(at["positions"], lower, upper)


def _in_space(vectors: NDArray[Any]) -> NDArray[Any]:
    return np.pad(vectors, ((0, 0), (0, 3 - vectors.shape[1])))
