"""The viscous force as a stress: its kernels (`cortado.sph.stress_kernels`), their arrays and their constants."""

import warp as wp

from cortado.discretise.calibration import stress_control
from cortado.particles.neighbourhood import Discretisation
from cortado.particles.state import Layout
from cortado.scene.scene import Scene
from cortado.sph.parts import Adjoints, Setting, StepContext, Tangents
from cortado.sph.stress_functions import matrix_type
from cortado.sph.stress_kernels import stress_kernels

CLOSEST = 0.25
"""In spacings: walls without slip pull no harder on particles that are closer, see `cortado.sph.stress_kernels`."""


class ViscousStress:
    """Viscosity as a stress; its arrays are those of the last step."""

    shares: tuple[str, ...] = ()  # viscosities reach particles through the mixture, which has the phases' adjoints
    batches = True

    def __init__(self, discretisation: Discretisation, scene: Scene, control: float, layout: Layout):
        """``control`` is C, as `stress_control` gives it."""
        sticks = getattr(scene.container, "slip", "free") == "no"
        self._stress, self._force = stress_kernels(discretisation, scene.dimension, sticks)
        self._constants = {"control": control, "least": CLOSEST * scene.discretisation.spacing}
        precision, matrix = layout.precision, matrix_type(layout.precision)
        kinds = {"M": matrix, "A": matrix, "R": precision.real, "T": matrix, "eta": precision.real}
        size, device = layout.all_particles, layout.device
        self._of = {
            name: wp.zeros(size, dtype=kind, device=device, requires_grad=discretisation.taped)
            for name, kind in kinds.items()
        }
        self._change = {name: wp.zeros(size, dtype=kind, device=device) for name, kind in kinds.items()}
        """Tangents of T and eta, or adjoints of M, A and R."""

    def accelerate(self, step: StepContext, before: wp.array, after: wp.array) -> None:
        step.launch(self._stress.forward, self._constants, **self._of)
        step.launch(self._force.forward, self._constants, self._of, acceleration_in=before, acceleration=after)

    def tangent(self, step: StepContext, dot: Tangents, before: wp.array, after: wp.array) -> None:
        known = (*dot.named, self._constants, self._of)
        change = {f"{name}_dot": self._change[name] for name in ("T", "eta")}
        step.launch(self._stress.tangent, *known, **change)
        step.launch(self._force.tangent, *known, change, acceleration_in_dot=before, acceleration_dot=after)

    def adjoint(self, step: StepContext, acceleration_bar: wp.array, bar: Adjoints) -> None:
        known = (*bar.named, self._constants, self._of, {"acceleration_bar": acceleration_bar})
        change = {f"{name}_bar": self._change[name] for name in ("M", "A", "R")}
        step.launch(self._stress.adjoint, *known, **change)
        step.launch(self._force.adjoint, *known, change)


def viscous_stress(setting: Setting) -> ViscousStress:
    """The force of a scene."""
    scene, smoothing = setting.scene, setting.discretisation.smoothing
    cut = scene.discretisation
    control = stress_control(smoothing, cut.spacing, cut.support_radius, scene.dimension)
    return ViscousStress(setting.discretisation, scene, control, setting.layout)
