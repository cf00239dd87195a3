"""A picture of a colour field on a device, with its tangent and the way back from it."""

from functools import cached_property, partial
from math import prod
from typing import Any

import numpy as np
import warp as wp

from cortado.device.launching import launch
from cortado.device.memory import field_parts, picture_parts, require, sample_parts
from cortado.device.precision import Precision
from cortado.device.reduction import sum_of
from cortado.render.absorption import absorption_kernels, pose_type
from cortado.render.calibration import ViewTangent
from cortado.render.cameras import Camera
from cortado.render.colour_field import rgba_type
from cortado.render.rays import camera_tangent_type, camera_type
from cortado.render.views import View

SAMPLES_PER_CELL = 2
"""Samples of a ray on one node distance."""


def camera_struct(camera: Camera, step: float, precision: Precision) -> Any:
    """What kernels see of a camera whose samples are so far apart [m]."""
    struct = camera_type(precision)()
    struct.position = precision.vector(*camera.position)
    struct.orientation = type(struct.orientation)(*camera.orientation.ravel())
    struct.half_width, struct.growth = camera.half_width
    struct.columns, struct.rows = camera.resolution
    struct.near, struct.step = camera.near, step
    struct.samples = int(np.ceil((camera.reach - camera.near) / step))
    return struct


def camera_tangent(along: ViewTangent, step: float, precision: Precision) -> Any:
    """What kernels see of how a view changes whose samples are so far apart [m]."""
    struct = camera_tangent_type(precision)()
    struct.position, struct.turn = precision.vector(*along.translation), precision.vector(*along.rotation)
    struct.half_width, struct.growth = along.half_width
    struct.thickness = along.extinction * step
    return struct


class RayMarcher:
    """Makes pictures of one view of fields. What `adjoint` returns is overwritten by its next call."""

    def __init__(self, view: View, nodes: Any, precision: Precision, device: Any):
        """``nodes`` as `ColourField.nodes`."""
        self._step = step = nodes.cell / SAMPLES_PER_CELL
        self._camera, self._nodes = camera_struct(view.camera, step, precision), nodes
        self._thickness, self._background = view.extinction * step, precision.vector(*view.background)
        self._kernels = absorption_kernels(precision)
        self._zeros = partial(wp.zeros, device=device)
        self._ink, self._pose = rgba_type(precision), pose_type(precision)
        self.pixels, self._precision, self._device = self._camera.rows * self._camera.columns, precision, device
        require(picture_parts(self.pixels, precision.bytes), "take a smaller resolution", device)
        self.image, self._image_bar = (self._zeros(self.pixels, dtype=precision.vector) for _ in range(2))
        """(pixels,) linear RGB, row by row."""
        self._spans = self._zeros(self.pixels, dtype=wp.vec2i)
        self._known = {
            "camera": self._camera,
            "nodes": nodes,
            "thickness": self._thickness,
            "image": self.image,
            "spans": self._spans,
        }
        self._pose_bar = self._zeros(self.pixels, dtype=self._pose)
        self._sum = sum_of(self._pose, self.pixels, device)

    def march(self, field: wp.array) -> None:
        """Make the image of a field (nz, ny, nx)."""
        launch(self._kernels.forward, self.pixels, self._device, self._known, background=self._background, field=field)

    def tangent(self, field: wp.array, field_dot: wp.array, along: ViewTangent) -> wp.array:
        """The tangent (pixels,) of the image of the field, along that of the field and that of the view. The next call
        overwrites it, and so does `adjoint`."""
        camera_dot = camera_tangent(along, self._step, self._precision)
        given = {"background": self._background, "field": field, "field_dot": field_dot, "camera_dot": camera_dot}
        launch(self._kernels.tangent, self.pixels, self._device, self._known, given, image_dot=self._image_bar)
        return self._image_bar

    def adjoint(self, image_bar: np.ndarray, field: wp.array) -> tuple[wp.array, np.ndarray]:
        """The derivative with respect to the field and to the pose (6,), from that with respect to the image (pixels,
        3) of the field."""
        self._image_bar.assign(image_bar)
        bars = {"image_bar": self._image_bar, "samples_bar": self._samples_bar, "pose_bar": self._pose_bar}
        launch(self._kernels.adjoint, self.pixels, self._device, self._known, bars, field=field)
        launch(self._kernels.gather, field.shape, self._device, self._known, bars, field_bar=self._field_bar)
        return self._field_bar, self._sum(self._pose_bar).numpy()[0].astype(np.float64)

    @cached_property
    def _samples_bar(self) -> wp.array:
        """(samples, pixels): the greatest array by far, made when it is first needed. No ray has more samples in the
        field than its diagonal has room for."""
        cells = np.linalg.norm(np.array(self._nodes.shape) + 1)
        samples = min(int(cells * SAMPLES_PER_CELL) + 4, self._camera.samples)
        parts = sample_parts(samples, self.pixels, self._precision.bytes)
        parts |= field_parts(prod(self._nodes.shape), self._precision.bytes)
        require(parts, "take a smaller resolution or a larger spacing", self._device)
        return self._zeros((samples, self.pixels), dtype=self._ink)

    @cached_property
    def _field_bar(self) -> wp.array:
        return self._zeros(tuple(self._nodes.shape)[::-1], dtype=self._ink)
