"""Colours of particles, mixed from the colours of their phases: colour_j = sum_k c_jk colours_k."""

from dataclasses import dataclass
from functools import cache
from typing import Any

import warp as wp

from cortado.device.modules import kernel_module
from cortado.device.precision import Precision


@cache
def colours_type(precision: Precision, phases: int) -> Any:
    """Warp matrix type (phases, 3)."""
    return wp.types.matrix(shape=(phases, 3), dtype=precision.real)


@dataclass(frozen=True)
class PhaseColourKernels:
    """The kernel of particles' colours, its tangent and its adjoint."""

    forward: Any
    tangent: Any
    adjoint: Any


@cache
def phase_colour_kernels(precision: Precision, phases: int) -> PhaseColourKernels:
    """Kernels ``forward`` and ``tangent`` (which sort positions besides), and ``adjoint``."""
    vector, fractions = precision.vector, precision.fractions(phases)
    colours_matrix = colours_type(precision, phases)
    module = kernel_module(f"phase_colour_{phases}_{precision.name}")

    @wp.kernel(module=module, enable_backward=False)
    def phase_colour(
        colours: wp.array(dtype=colours_matrix),
        order: wp.array(dtype=wp.int32),
        x_scene: wp.array(dtype=vector),
        c_scene: wp.array(dtype=fractions),
        # out
        x: wp.array(dtype=vector),
        colour: wp.array(dtype=vector),
    ):
        i = wp.tid()
        j = order[i]
        x[i] = x_scene[j]
        colour[i] = wp.transpose(colours[0]) * c_scene[j]

    @wp.kernel(module=module, enable_backward=False)
    def phase_colour_tangent(
        colours: wp.array(dtype=colours_matrix),
        order: wp.array(dtype=wp.int32),
        c_scene: wp.array(dtype=fractions),
        x_scene_dot: wp.array(dtype=vector),
        c_scene_dot: wp.array(dtype=fractions),
        colours_dot: wp.array(dtype=colours_matrix),
        # out
        x_dot: wp.array(dtype=vector),
        colour_dot: wp.array(dtype=vector),
    ):
        i = wp.tid()
        j = order[i]
        x_dot[i] = x_scene_dot[j]
        colour_dot[i] = wp.transpose(colours[0]) * c_scene_dot[j] + wp.transpose(colours_dot[0]) * c_scene[j]

    @wp.kernel(module=module, enable_backward=False)
    def phase_colour_adjoint(
        colours: wp.array(dtype=colours_matrix),
        c_scene: wp.array(dtype=fractions),
        colour_scene_bar: wp.array(dtype=vector),
        # out
        c_scene_bar: wp.array(dtype=fractions),
        colours_bar: wp.array(dtype=colours_matrix),
    ):
        """``colours_bar`` gathers the adjoint of the colours particle by particle."""
        j = wp.tid()
        bar = colour_scene_bar[j]
        c_scene_bar[j] = colours[0] * bar
        colours_bar[j] = wp.outer(c_scene[j], bar)

    return PhaseColourKernels(forward=phase_colour, tangent=phase_colour_tangent, adjoint=phase_colour_adjoint)
