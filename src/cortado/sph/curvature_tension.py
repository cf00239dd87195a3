"""The force of surface tension by curvature: its kernels (`cortado.sph.curvature_kernels`) and their arrays."""

import warp as wp

from cortado.particles.arrays import zeros
from cortado.particles.neighbourhood import Discretisation
from cortado.particles.state import Layout
from cortado.sph.curvature_constants import CurvatureConstants
from cortado.sph.curvature_kernels import curvature_kernels, entries
from cortado.sph.parts import Adjoints, StepContext, Tangents


class CurvatureTension:
    """Surface tension by curvature; its arrays are those of the last step."""

    shares: tuple[str, ...] = ("surface_tension",)
    batches = True

    def __init__(self, discretisation: Discretisation, dimension: int, constants: CurvatureConstants, layout: Layout):
        self._kernels = curvature_kernels(discretisation, dimension)
        self._constants = {
            "spacing": constants.spacing,
            "depth": constants.depth,
            "per_width": 1.0 / constants.width,
        }
        kinds = {name: (layout.all_particles, kind) for name, kind in entries(layout.precision).items()}
        self._of = zeros(kinds, layout.device, discretisation.taped)
        self._change = zeros({**kinds, "r": kinds["g"]}, layout.device)
        """Tangents or adjoints, and r."""
        self._dot, self._bar = ({f"{name}_{kind}": self._change[name] for name in kinds} for kind in ("dot", "bar"))

    def accelerate(self, step: StepContext, before: wp.array, after: wp.array) -> None:
        known = self._constants, self._of
        for kernels in self._kernels.colour, self._kernels.normal, self._kernels.bend:
            step.launch(kernels.forward, *known)
        step.launch(self._kernels.mean.forward, *known, acceleration_in=before, acceleration=after)

    def tangent(self, step: StepContext, dot: Tangents, before: wp.array, after: wp.array) -> None:
        known = *dot.named, self._constants, self._of, self._dot
        for kernels in self._kernels.colour, self._kernels.normal, self._kernels.bend:
            step.launch(kernels.tangent, *known)
        step.launch(self._kernels.mean.tangent, *known, acceleration_in_dot=before, acceleration_dot=after)

    def adjoint(self, step: StepContext, acceleration_bar: wp.array, bar: Adjoints) -> None:
        known = *bar.named, self._constants, self._of, self._bar, {"r": self._change["r"]}
        force, mean = self._kernels.mean.adjoint
        step.launch(force, *known, acceleration_bar=acceleration_bar)
        for kernel in mean, self._kernels.bend.adjoint, self._kernels.normal.adjoint, self._kernels.colour.adjoint:
            step.launch(kernel, *known)
