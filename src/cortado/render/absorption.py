"""Emission and absorption along a ray, front to back (Max 1995), through the colour field (P, A).

A sample of the thickness kappa ds (the extinction times the step) lets exp(-u) of what comes from behind through, where
u = kappa ds A, and adds kappa ds P E(u), where E(u) = (1 - exp(-u)) / u: the emission of a layer whose colour is P / A,
without the division. With T_0 = 1,

    image = sum_s T_s kappa ds P_s E(u_s) + T_S background,    T_(s + 1) = T_s exp(-u_s).

On the way back what comes from behind a sample is the image less what came up to there, so that one pass over the
samples does, which may be as dark behind as they like.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.device.modules import kernel_module
from cortado.device.precision import Precision
from cortado.render.colour_field import node_functions, nodes_type, rgba_type
from cortado.render.interpolation import interpolation_functions
from cortado.render.rays import camera_tangent_type, camera_type, ray_functions


@cache
def pose_type(precision: Precision) -> Any:
    """Warp vector type of the adjoint of a pose: for the position (3), for a turn about it (3)."""
    return wp.types.vector(length=6, dtype=precision.real)


@dataclass(frozen=True)
class BrightnessFunctions:
    """Warp functions of what a sample lets through."""

    brightness: Any
    brightness_derivative: Any


@cache
def brightness_functions(precision: Precision) -> BrightnessFunctions:
    """Warp functions ``brightness`` E(u) and ``brightness_derivative`` E'(u); both take exp(-u) besides."""
    real = precision.real

    @wp.func
    def brightness(u: real, passed: real) -> real:
        """Below 0.1, where the formula cancels, the series sum_n (-u)^n / (n + 1)!: its rest is below 1e-17."""
        if u > real(0.1):
            return (real(1.0) - passed) / u
        total = real(1.0)
        for n in range(10):
            total = real(1.0) - total * u / real(11 - n)
        return total

    @wp.func
    def brightness_derivative(u: real, passed: real) -> real:
        """Below 0.1 the series -sum_n (n + 1) (-u)^n / (n + 2)!."""
        if u > real(0.1):
            return (passed * (real(1.0) + u) - real(1.0)) / (u * u)
        total = real(1.0)
        for n in range(10):
            total = real(1.0) - total * u * real(11 - n) / (real(10 - n) * real(12 - n))
        return real(-0.5) * total

    return BrightnessFunctions(brightness=brightness, brightness_derivative=brightness_derivative)


@dataclass(frozen=True)
class AbsorptionKernels:
    """The kernels that march along rays, along a tangent, and back."""

    forward: Any
    tangent: Any
    adjoint: Any
    gather: Any


@cache
def absorption_kernels(precision: Precision) -> AbsorptionKernels:
    """Kernels over pixels: ``forward``, ``tangent`` and ``adjoint``; and over nodes: ``gather``, of the adjoints of
    samples."""
    real, vector, rgba, pose = precision.real, precision.vector, rgba_type(precision), pose_type(precision)
    nodes_struct, camera_struct = nodes_type(precision), camera_type(precision)
    camera_tangent = camera_tangent_type(precision)
    rays, interpolation = ray_functions(precision), interpolation_functions(precision)
    start, direction, distance = rays.start, rays.direction, rays.distance
    start_tangent, direction_tangent = rays.start_tangent, rays.direction_tangent
    samples_within, pixels_before = rays.samples_within, rays.pixels_before
    value, gradient, trilinear_weight = interpolation.value, interpolation.gradient, interpolation.trilinear_weight
    derivative = interpolation.derivative
    shining = brightness_functions(precision)
    brightness, brightness_derivative = shining.brightness, shining.brightness_derivative
    place = node_functions(precision).place
    module = kernel_module(f"absorption_{precision.name}")

    @wp.func
    def diagonal(nodes: nodes_struct) -> vector:
        """Of one cell."""
        return vector(nodes.cell, nodes.cell, nodes.cell)

    @wp.kernel(module=module, enable_backward=False)
    def march(
        camera: camera_struct,
        nodes: nodes_struct,
        thickness: real,
        background: vector,
        field: wp.array3d(dtype=rgba),
        # out
        image: wp.array(dtype=vector),
        spans: wp.array(dtype=wp.vec2i),
    ):
        """``spans`` are the samples that may lie in the field: all others are empty."""
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
    def march_tangent(
        camera: camera_struct,
        nodes: nodes_struct,
        thickness: real,
        background: vector,
        spans: wp.array(dtype=wp.vec2i),
        field: wp.array3d(dtype=rgba),
        camera_dot: camera_tangent,
        field_dot: wp.array3d(dtype=rgba),
        # out
        image_dot: wp.array(dtype=vector),
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
    def march_adjoint(
        camera: camera_struct,
        nodes: nodes_struct,
        thickness: real,
        field: wp.array3d(dtype=rgba),
        image: wp.array(dtype=vector),
        spans: wp.array(dtype=wp.vec2i),
        image_bar: wp.array(dtype=vector),
        # out
        samples_bar: wp.array2d(dtype=rgba),
        pose_bar: wp.array(dtype=pose),
    ):
        """``samples_bar`` [sample of the span, pixel]; ``pose_bar`` gathers the adjoint of the pose ray by ray."""
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
    def gather(
        camera: camera_struct,
        nodes: nodes_struct,
        spans: wp.array(dtype=wp.vec2i),
        samples_bar: wp.array2d(dtype=rgba),
        # out
        field_bar: wp.array3d(dtype=rgba),
    ):
        """Every node gathers from the samples in the eight cells around it, found by way of the screen."""
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

    return AbsorptionKernels(forward=march, tangent=march_tangent, adjoint=march_adjoint, gather=gather)
