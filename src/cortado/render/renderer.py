"""From particles to a picture and back (report section 5.3)."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from cortado.errors import InputError, shown
from cortado.precision import Precision
from cortado.render.cameras import positive, vector
from cortado.render.fields import ColourField
from cortado.render.marching import RayMarcher
from cortado.render.views import View
from cortado.smoothing import SmoothingKernel


@dataclass(frozen=True)
class RenderAdjoint:
    """The derivative of a function of the image. The Warp arrays belong to the renderer, and its next call overwrites
    them."""

    positions: wp.array
    """(n,) vectors [1 / m]."""
    fractions: wp.array
    """(n,) vectors of one number for each phase [-]."""
    colours: np.ndarray
    """(phases, 3) [-]"""
    translation: np.ndarray
    """(3,) with respect to the position of the camera [1 / m]."""
    rotation: np.ndarray
    """(3,) with respect to a rotation vector that turns the camera about its position [1 / rad]."""


class Renderer:
    """Renders a fixed number of particles into pictures of one view, on one device; pictures are linear RGB.

    They are smooth functions of positions, fractions and colours, and piecewise smooth ones of the camera's pose: where
    samples lie on faces between cells of the colour field, as those of a view along an axis may, the derivative with
    respect to the pose is one-sided.
    """

    def __init__(
        self,
        view: View,
        lower: Sequence[float] | np.ndarray,
        upper: Sequence[float] | np.ndarray,
        *,
        smoothing: SmoothingKernel,
        support: float,
        volume: float,
        particles: int,
        phases: int,
        precision: Precision,
        device: Any,
        dimension: int = 3,
        cell: float | None = None,
        periods: Sequence[float] | np.ndarray | None = None,
    ):
        """Fluid is seen from ``lower`` to ``upper`` (d,) [m], and by the support radius [m] beyond.

        Along an axis with a period (``periods`` (d,) [m], 0 without one) fluid is seen wherever an image of it is
        between ``lower`` and ``upper``.

        ``volume`` is the rest volume of a particle [m^d], ``cell`` the distance of nodes [m], by default half the
        support radius.
        """
        cell = 0.5 * support if cell is None else cell
        for name, size in (("support", support), ("volume", volume), ("cell", cell)):
            positive(name, size)
        for name, number in (("particles", particles), ("phases", phases)):
            if number < 1:
                raise InputError(f"{name} is {shown(number)}, but must be at least 1.")
        low, high = np.array(vector("lower", lower, dimension)), np.array(vector("upper", upper, dimension))
        if not (high >= low).all():
            raise InputError(f"upper is {shown(high.tolist())}, but must not be below lower, {shown(low.tolist())}.")
        turns = np.zeros(dimension) if periods is None else np.array(vector("periods", periods, dimension))
        if ((turns != 0.0) & (turns <= 2.0 * support)).any():
            raise InputError(
                f"periods is {shown(turns.tolist())}, but must be 0 or greater than two support radii, "
                f"{2.0 * support:g} m."
            )
        self.view = view
        self._particles, self._phases, self._precision = particles, phases, precision
        device = wp.get_device(device)
        self._field = ColourField(
            low, high, turns, cell, smoothing, support, volume, particles, phases, precision, device
        )
        self._rays = RayMarcher(view, self._field.nodes, precision, device)
        self._rendered = False

    @property
    def fingerprint(self) -> str:
        """Tells one view from another, for checkpoints, and one grid of nodes."""
        nodes = self._field.nodes
        return f"{self.view!r} {tuple(nodes.origin)} {nodes.cell} {tuple(nodes.shape)} {tuple(nodes.period)}"

    @property
    def shape(self) -> tuple[int, int, int]:
        """Of a picture: rows, columns, 3."""
        columns, rows = self.view.camera.resolution
        return rows, columns, 3

    def render(self, positions: wp.array, fractions: wp.array, colours: np.ndarray) -> np.ndarray:
        """The picture (rows, columns, 3), in float64, row 0 at the top.

        Of positions (n,) [m], mass fractions (n,) [-], as vectors of the renderer's precision, and the colours
        (phases, 3) of the phases.
        """
        self._check("positions", positions, self._precision.vector)
        self._check("fractions", fractions, self._precision.fractions(self._phases))
        colours = np.asarray(colours, dtype=np.float64)
        if colours.shape != (self._phases, 3):
            raise InputError(f"colours has shape {colours.shape}, but must have {(self._phases, 3)}.")
        self._field.gather(positions, fractions, colours)
        self._rays.march(self._field.values)
        self._rendered = True
        return self._rays.image.numpy().astype(np.float64).reshape(self.shape)

    def adjoint(self, image_bar: np.ndarray) -> RenderAdjoint:
        """The derivative of a function of the last picture, from its derivative with respect to that picture (rows,
        columns, 3)."""
        if not self._rendered:
            raise InputError("There is no picture to go back from; call render before adjoint.")
        image_bar = np.asarray(image_bar, dtype=np.float64)
        if image_bar.shape != self.shape:
            raise InputError(f"image_bar has shape {image_bar.shape}, but must have that of the picture, {self.shape}.")
        field_bar, pose = self._rays.adjoint(image_bar.reshape(-1, 3), self._field.values)
        return RenderAdjoint(*self._field.adjoint(field_bar), pose[:3], pose[3:])

    def field(self) -> tuple[np.ndarray, np.ndarray]:
        """Coverage (nx, ny, nz) and colour times coverage (nx, ny, nz, 3) [-] at the nodes, of the last picture."""
        found = self._field.values.numpy().astype(np.float64).transpose(2, 1, 0, 3)
        return found[..., 3].copy(), found[..., :3].copy()

    def nodes(self) -> np.ndarray:
        """Where the nodes are (nx, ny, nz, 3) [m]."""
        nodes = self._field.nodes
        indices = np.moveaxis(np.indices(tuple(nodes.shape)), 0, -1)
        return np.array(nodes.origin, dtype=np.float64) + nodes.cell * indices

    def _check(self, name: str, values: wp.array, dtype: Any) -> None:
        if values.shape != (self._particles,) or not wp.types.types_equal(values.dtype, dtype):
            found = f"{values.dtype.__name__} of shape {values.shape}"
            raise InputError(f"{name} is {found}, but must be {dtype.__name__} of shape {(self._particles,)}.")
