"""Emission and absorption of light along a ray through the colour field, from front to back (Max 1995).

The colour field consists of the coverage A and the colour times coverage P. A sample has the optical thickness u =
kappa ds A, with extinction kappa and step ds. The sample transmits the fraction exp(-u) of the light from behind the
sample.

The sample emits the light kappa ds P E(u), with E(u) = (1 - exp(-u)) / u. A layer of colour P / A emits the same light,
but kappa ds P E(u) has no division by A.

Light from sample s reaches the camera with the transmittance T_s, and T_0 is 1. For S samples the image is

    image = sum_s T_s kappa ds P_s E(u_s) + T_S background,    T_(s + 1) = T_s exp(-u_s).

In the adjoint, the light from behind a sample is the image minus the light of all samples before the sample. The
adjoint therefore needs only one pass over the samples.
"""

from functools import cache, cached_property, partial
from math import prod
from typing import Any

import numpy as np
import warp as wp

from cortado.device.launching import launch
from cortado.device.modules import Kernels, kernel_module
from cortado.device.precision import Precision, TypesByName
from cortado.device.reduction import sum_of
from cortado.device.threads import field_parts, picture_parts, require, sample_parts
from cortado.render.cameras import View, ViewTangent
from cortado.render.colour_field import node_functions, nodes_type, rgba_type
from cortado.render.rays import camera_tangent_type, camera_type, interpolation_functions, ray_functions

SAMPLES_PER_CELL = 2


@cache
def brightness_functions(precision: Precision) -> tuple[Any, Any]:
    """Return Warp functions of u and exp(-u): E(u) = (1 - exp(-u)) / u, and its derivative."""
    real = precision.real

    @wp.func
    def brightness(u: real, passed: real) -> real:
        """Below u = 0.1 a power series avoids cancellation."""
        if u > real(0.1):
            return (real(1.0) - passed) / u
        total = real(1.0)
        for n in range(10):
            total = real(1.0) - total * u / real(11 - n)
        return total

    @wp.func
    def brightness_derivative(u: real, passed: real) -> real:
        """Below u = 0.1 a power series avoids cancellation."""
        if u > real(0.1):
            return (passed * (real(1.0) + u) - real(1.0)) / (u * u)
        total = real(1.0)
        for n in range(10):
            total = real(1.0) - total * u * real(11 - n) / (real(10 - n) * real(12 - n))
        return real(-0.5) * total

    return brightness, brightness_derivative


@cache
def absorption_kernels(precision: Precision) -> tuple[Kernels, Any]:
    """Return the kernels of ray marching, and the kernel for the adjoint of the colour field."""
    real, vector, rgba, pose = precision.real, precision.vector, rgba_type(precision), precision.six
    nodes_struct, camera_struct = nodes_type(precision), camera_type(precision)
    change = camera_tangent_type(precision)
    start, direction, distance, *tangents, samples_within, pixels_before = ray_functions(precision)
    start_tangent, direction_tangent = tangents
    value, gradient, derivative, trilinear_weight = interpolation_functions(precision)
    brightness, brightness_derivative = brightness_functions(precision)
    place, *_ = node_functions(precision)
    module = kernel_module(f"absorption_{precision.name}")

    @wp.func
    def diagonal(nodes: nodes_struct) -> vector:
        return vector(nodes.cell, nodes.cell, nodes.cell)

    samples, poses = wp.array2d(dtype=rgba), wp.array(dtype=pose)
    names = {camera_struct: "camera", change: "camera_dot", nodes_struct: "nodes", vector: "image", wp.vec2i: "spans"}
    typed = TypesByName(real, {**names, wp.array3d(dtype=rgba): "field"})

    @wp.kernel(module=module, enable_backward=False)
    @typed.arrays
    def march(camera, nodes, thickness: real, background: vector, field, image, spans):
        """``spans`` has the range of samples inside the grid for each ray."""
        pixel = wp.tid()
        o = start(pixel, camera)
        d = direction(pixel, camera)
        last_node = place(nodes.shape[0] - 1, nodes.shape[1] - 1, nodes.shape[2] - 1, nodes)
        span = samples_within(o, d, nodes.origin - diagonal(nodes), last_node + diagonal(nodes), camera)
        total = vector()
        transmitted = real(1.0)
        for s in range(span[0], span[1]):
            q = value(o + distance(s, camera) * d, field, nodes)
            u = thickness * q[3]
            passed = wp.exp(-u)
            total += (transmitted * thickness * brightness(u, passed)) * vector(q[0], q[1], q[2])
            transmitted = transmitted * passed
        image[pixel] = total + transmitted * background
        spans[pixel] = span

    @wp.kernel(module=module, enable_backward=False)
    @typed.arrays
    def march_tangent(
        camera, nodes, thickness: real, background: vector, spans, field, camera_dot, field_dot, image_dot
    ):
        pixel = wp.tid()
        o = start(pixel, camera)
        d = direction(pixel, camera)
        o_dot = start_tangent(pixel, camera, camera_dot)
        d_dot = direction_tangent(pixel, camera, camera_dot)
        total_dot = vector()
        transmitted = real(1.0)
        transmitted_dot = real(0.0)
        span = spans[pixel]
        for s in range(span[0], span[1]):
            x = o + distance(s, camera) * d
            q = value(x, field, nodes)
            q_dot = value(x, field_dot, nodes)
            q_dot += derivative(x, o_dot + distance(s, camera) * d_dot, field, nodes)
            u = thickness * q[3]
            u_dot = thickness * q_dot[3] + camera_dot.thickness * q[3]
            passed = wp.exp(-u)
            shine = brightness(u, passed)
            seen_dot = (transmitted_dot * thickness + transmitted * camera_dot.thickness) * shine
            seen_dot += transmitted * thickness * brightness_derivative(u, passed) * u_dot
            total_dot += seen_dot * vector(q[0], q[1], q[2])
            total_dot += (transmitted * thickness * shine) * vector(q_dot[0], q_dot[1], q_dot[2])
            transmitted_dot = (transmitted_dot - transmitted * u_dot) * passed
            transmitted = transmitted * passed
        image_dot[pixel] = total_dot + transmitted_dot * background

    @wp.kernel(module=module, enable_backward=False)
    @typed.arrays
    def march_adjoint(
        camera, nodes, thickness: real, field, image, spans, image_bar, samples_bar: samples, pose_bar: poses
    ):
        pixel = wp.tid()
        bar = image_bar[pixel]
        o = start(pixel, camera)
        d = direction(pixel, camera)
        behind = wp.dot(image[pixel], bar)
        transmitted = real(1.0)
        push = vector()
        turn = vector()
        span = spans[pixel]
        for s in range(span[0], span[1]):
            x = o + distance(s, camera) * d
            q = value(x, field, nodes)
            u = thickness * q[3]
            passed = wp.exp(-u)
            seen = transmitted * thickness
            shine = brightness(u, passed)
            colour_bar = wp.dot(vector(q[0], q[1], q[2]), bar)
            behind = behind - seen * shine * colour_bar
            coverage_bar = thickness * (seen * brightness_derivative(u, passed) * colour_bar - behind)
            p_bar = (seen * shine) * bar
            q_bar = rgba(p_bar[0], p_bar[1], p_bar[2], coverage_bar)
            samples_bar[s - span[0], pixel] = q_bar
            x_bar = gradient(x, q_bar, field, nodes)
            push += x_bar
            turn += wp.cross(x - camera.position, x_bar)
            transmitted = transmitted * passed
        pose_bar[pixel] = pose(push[0], push[1], push[2], turn[0], turn[1], turn[2])

    @wp.kernel(module=module, enable_backward=False)
    @typed.arrays
    def gather(camera, nodes, spans, samples_bar: samples, field_bar):
        """Sum the adjoints of the samples in the eight cells around each node."""
        k, j, i = wp.tid()
        x_g = place(i, j, k, nodes)
        lower = x_g - diagonal(nodes)
        upper = x_g + diagonal(nodes)
        window = pixels_before(lower, upper, camera)
        total = rgba()
        for row in range(window[2], window[3]):
            for column in range(window[0], window[1]):
                pixel = row * camera.columns + column
                o = start(pixel, camera)
                d = direction(pixel, camera)
                near_by = samples_within(o, d, lower, upper, camera)
                span = spans[pixel]
                for s in range(wp.max(near_by[0], span[0]), wp.min(near_by[1], span[1])):
                    total += trilinear_weight(o + distance(s, camera) * d, x_g, nodes) * samples_bar[s - span[0], pixel]
        field_bar[k, j, i] = total

    return Kernels(march, march_tangent, march_adjoint), gather


class RayMarcher:
    """Renders colour fields from one view by ray marching. Each call of ``adjoint`` overwrites the previous result."""

    def __init__(self, view: View, nodes: Any, precision: Precision, device: Any):
        self._step = step = nodes.cell / SAMPLES_PER_CELL
        seen, self._camera, self._nodes = view.camera, camera_type(precision)(), nodes
        self._camera.position = precision.vector(*seen.position)
        self._camera.orientation = precision.matrix(*seen.orientation.ravel())
        self._camera.half_width, self._camera.growth = seen.half_width
        self._camera.columns, self._camera.rows = seen.resolution
        self._camera.near, self._camera.step = seen.near, step
        self._camera.samples = int(np.ceil((seen.reach - seen.near) / step))
        self._thickness, self._background = view.extinction * step, precision.vector(*view.background)
        self._kernels, self._gather = absorption_kernels(precision)
        self._zeros = partial(wp.zeros, device=device)
        self.pixels, self._precision, self._device = self._camera.rows * self._camera.columns, precision, device
        require(picture_parts(self.pixels, precision.bytes), "take a smaller resolution", device)
        self.image, self._image_bar = (self._zeros(self.pixels, dtype=precision.vector) for _ in range(2))
        """The image (pixels,) in linear RGB, and the adjoint of the image (pixels,)."""
        self._spans = self._zeros(self.pixels, dtype=wp.vec2i)
        self._known = {"camera": self._camera, "nodes": nodes, "thickness": self._thickness}
        self._known |= {"image": self.image, "spans": self._spans}
        self._pose_bar = self._zeros(self.pixels, dtype=precision.six)
        self._sum = sum_of(precision.six, self.pixels, device)

    def march(self, field: wp.array) -> None:
        launch(self._kernels.forward, self.pixels, self._device, self._known, background=self._background, field=field)

    def tangent(self, field: wp.array, field_dot: wp.array, along: ViewTangent) -> wp.array:
        """Return the tangent of the image (pixels,). The next ``tangent`` or ``adjoint`` overwrites the result."""
        vector, camera_dot = self._precision.vector, camera_tangent_type(self._precision)()
        camera_dot.position, camera_dot.turn = vector(*along.translation), vector(*along.rotation)
        camera_dot.half_width, camera_dot.growth = along.half_width
        camera_dot.thickness = along.extinction * self._step
        given = {"background": self._background, "field": field, "field_dot": field_dot, "camera_dot": camera_dot}
        launch(self._kernels.tangent, self.pixels, self._device, self._known, given, image_dot=self._image_bar)
        return self._image_bar

    def adjoint(self, image_bar: np.ndarray, field: wp.array) -> tuple[wp.array, np.ndarray]:
        """Return the derivatives of a function of the image with respect to the field and the camera's pose (6,).
        ``image_bar``         (pixels, 3) is the derivative with respect to the image."""
        self._image_bar.assign(image_bar)
        bars = {"image_bar": self._image_bar, "samples_bar": self._samples_bar, "pose_bar": self._pose_bar}
        launch(self._kernels.adjoint, self.pixels, self._device, self._known, bars, field=field)
        launch(self._gather, field.shape, self._device, self._known, bars, field_bar=self._field_bar)
        return self._field_bar, self._sum(self._pose_bar).numpy()[0].astype(np.float64)

    @cached_property
    def _samples_bar(self) -> wp.array:
        cells = np.linalg.norm(np.array(self._nodes.shape) + 1)
        samples = min(int(cells * SAMPLES_PER_CELL) + 4, self._camera.samples)
        parts = sample_parts(samples, self.pixels, self._precision.bytes)
        parts |= field_parts(prod(self._nodes.shape), self._precision.bytes)
        require(parts, "take a smaller resolution or a larger spacing", self._device)
        return self._zeros((samples, self.pixels), dtype=rgba_type(self._precision))

    @cached_property
    def _field_bar(self) -> wp.array:
        return self._zeros(tuple(self._nodes.shape)[::-1], dtype=rgba_type(self._precision))
