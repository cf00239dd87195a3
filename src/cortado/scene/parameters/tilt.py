"""Gravity that leans: of the size that it has at rest, in another direction. It is what a tilted container feels."""

from dataclasses import dataclass

import numpy as np

SMALL = 1e-2
"""Angles [rad] below which a series takes the place of a division by them; what it leaves out is below round-off."""


@dataclass(frozen=True)
class Tilt:
    """Gravity g(a) = |g| (cos|a| e_0 + sin|a| / |a| sum_k a_k e_k) of angles a (d - 1,) [degrees] from the rest e_0.

    The unit vectors e_k are the axes other than the one that gravity at rest is most nearly along, in their order, made
    perpendicular to it and to each other: where it is along -y, gravity leans towards x by a_1 and towards z by a_2.
    The map is smooth, at rest as well (it is the exponential map of the sphere), and there and back for |a| < 180.
    """

    rest: tuple[float, ...]
    """(d,) gravity without a tilt [m/s2], not 0."""

    def gravity(self, angles: np.ndarray) -> np.ndarray:
        """(d,) or (steps, d) [m/s2] of angles (d - 1,) or (steps, d - 1) [degrees]."""
        a = np.radians(angles)
        size = np.linalg.norm(a, axis=-1, keepdims=True)
        return self._size * np.concatenate([np.cos(size), np.sinc(size / np.pi) * a], axis=-1) @ self._axes

    def tangent(self, angles: np.ndarray, dot: np.ndarray) -> np.ndarray:
        """The derivative of `gravity` along ``dot`` [m/s2], of the angles' shape."""
        a, a_dot = np.radians(angles), np.radians(dot)
        sine, sine_derivative = self._factors(a)
        along = (a * a_dot).sum(axis=-1, keepdims=True)
        return (
            self._size
            * np.concatenate([-sine * along, sine * a_dot + sine_derivative * along * a], axis=-1)
            @ self._axes
        )

    def adjoint(self, angles: np.ndarray, bar: np.ndarray) -> np.ndarray:
        """The derivative with respect to the angles [1/degree], from that with respect to gravity."""
        a, bars = np.radians(angles), self._size * bar @ self._axes.T
        sine, sine_derivative = self._factors(a)
        rest_bar, lean_bar = bars[..., :1], bars[..., 1:]
        along = sine_derivative * (a * lean_bar).sum(axis=-1, keepdims=True) - sine * rest_bar
        return np.radians(sine * lean_bar + along * a)

    @property
    def towards(self) -> str:
        """The names of the axes that gravity leans towards, such as "xz"."""
        return "".join(np.delete(list("xyz"[: len(self.rest)]), np.abs(self.rest).argmax()))

    @property
    def _size(self) -> float:
        return float(np.linalg.norm(self.rest))

    @property
    def _axes(self) -> np.ndarray:
        """(d, d) rows e_0, e_1 ..."""
        rows = [np.array(self.rest) / self._size]
        for axis in np.delete(np.eye(len(self.rest)), np.abs(self.rest).argmax(), axis=0):
            rest = axis - sum((axis @ row) * row for row in rows)
            rows.append(rest / np.linalg.norm(rest))
        return np.array(rows)

    @staticmethod
    def _factors(a: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(..., 1) s = sin|a| / |a|, and its derivative along |a|, over |a|."""
        size = np.linalg.norm(a, axis=-1, keepdims=True)
        sine, safe = np.sinc(size / np.pi), np.maximum(size, SMALL)
        derivative = (np.cos(safe) - np.sinc(safe / np.pi)) / safe**2
        return sine, np.where(size < SMALL, -1.0 / 3.0 + size**2 / 30.0 - size**4 / 840.0, derivative)
