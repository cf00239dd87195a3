"""The viscous force as a stress: its kernels (`cortado.sph.stress_kernels`), their arrays and their constants."""

import warp as wp

from cortado.discretise.calibration import circulation_factor
from cortado.particles.neighbourhood import Discretisation
from cortado.particles.state import Layout
from cortado.scene.scene import Scene
from cortado.sph.parts import Adjoints, Setting, StepContext, Tangents
from cortado.sph.stress_functions import stress_functions
from cortado.sph.stress_kernels import stress_kernels

CLOSEST = 0.25
"""In spacings: walls without slip pull no harder on particles that are closer, see `cortado.sph.stress_kernels`."""


class ViscousStress:
    """Viscosity as a stress; its arrays are those of the last step."""

    shares: tuple[str, ...] = ()  # viscosities reach particles through the mixture, which has the phases' adjoints
    batches = True

    def __init__(self, discretisation: Discretisation, scene: Scene, control: float, layout: Layout):
        """``control`` is C, as `control_factor` gives it."""
        sticks = getattr(scene.container, "slip", "free") == "no"
        self._stress, self._force = stress_kernels(discretisation, scene.dimension, control, sticks)
        self._constants = {"least": CLOSEST * scene.discretisation.spacing}
        precision = layout.precision
        matrix = stress_functions(precision, scene.dimension, control).matrix
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


def control_factor(setting: Setting) -> float:
    """C = 4 / (3 m_2), with the second moment m_2 of s_ij on the lattice along an axis."""
    cut, smoothing = setting.scene.discretisation, setting.discretisation.smoothing
    return 4.0 / (3.0 * circulation_factor(smoothing, cut.spacing, cut.support_radius, setting.scene.dimension))


def viscous_stress(setting: Setting) -> ViscousStress:
    """The force of a scene."""
    return ViscousStress(setting.discretisation, setting.scene, control_factor(setting), setting.layout)
