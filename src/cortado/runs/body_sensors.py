"""Sensors of free bodies: the force of a spring, and the motion of a free body."""

from functools import cache
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from cortado.calls import fixed
from cortado.device.launching import Named
from cortado.device.modules import kernel_module
from cortado.device.precision import Precision
from cortado.errors import InputError, shown
from cortado.runs.particle_sums import LoadSum, Summed
from cortado.runs.quantity_formulas import SIX, Bars, QuantityFormula
from cortado.runs.sensor import Reading, SensedScene, named
from cortado.scene.links import Ends
from cortado.scene.motions import Pose, angular_velocity_name, position_name, velocity_name
from cortado.scene.parameters import load_name
from cortado.solvers.particles import ParticleSolver
from cortado.sph.parts import StepContext, Tangents
from cortado.sph.springs import NUMBERS, PoseBars, Springs, numbers_of, springs_in


@cache
def six_kernels(precision: Precision) -> tuple[Any, Any]:
    real, vector, module = precision.real, precision.vector, kernel_module(f"spring_load_{precision.name}")

    @wp.kernel(module=module, enable_backward=False)
    def widen(reading: wp.array(dtype=vector), load: wp.array(dtype=SIX)):
        i, no = wp.tid(), wp.float64(0.0)
        load[i] = SIX(wp.float64(reading[i][0]), wp.float64(reading[i][1]), no, no, no, no)

    @wp.kernel(module=module, enable_backward=False)
    def narrow(load_bar: wp.array(dtype=SIX), reading_bar: wp.array(dtype=vector)):
        i = wp.tid()
        reading_bar[i] = vector(real(load_bar[i][0]), real(load_bar[i][1]), real(0.0))

    return widen, narrow


class SpringLoads:
    """A load whose components are the force and the length of the spring at the start of a time step."""

    def __init__(self, springs: Springs, spring: Ends):
        layout, self._springs, self._spring = springs.layout, springs, spring
        self._threads, self._bars = layout.members, PoseBars(springs)
        self._widen, self._narrow = six_kernels(layout.precision)
        vectors = {"shape": layout.members, "dtype": layout.precision.vector, "device": layout.device}
        self._at = {name: wp.zeros(**vectors) for name in ("reading", "reading_bar")}
        self._load = wp.zeros(layout.members, dtype=SIX, device=layout.device)

    def _known(self, step: StepContext) -> tuple[Named, ...]:
        return numbers_of(step.parameters, self._spring.name, NUMBERS), *self._springs.known(self._spring)

    def _found(self, step: StepContext, kernel: Any, found: str, *more: Named) -> wp.array:
        step.launch(kernel, {found: self._at["reading"]}, *more, *self._known(step), threads=self._threads)
        step.launch(self._widen, load=self._load, reading=self._at["reading"], threads=self._threads)
        return self._load

    def value(self, step: StepContext, p: Any) -> wp.array:
        return self._found(step, self._springs.read.forward, "reading")

    def tangent(self, step: StepContext, p: Any, along: Tangents, p_dot: Any, stress_dot: Any) -> wp.array:
        sizes = {"time_step_dot": along.parameters["time_step"]}
        dots = numbers_of(along.parameters, self._spring.name, NUMBERS, "_dot")
        return self._found(step, self._springs.read.tangent, "reading_dot", sizes, dots)

    def adjoint(self, step: StepContext, p: Any, own: wp.array, bar: Bars) -> None:
        step.launch(self._narrow, load_bar=own, reading_bar=self._at["reading_bar"], threads=self._threads)
        bars = numbers_of(bar.of.parameters, self._spring.name, NUMBERS, "_bar")
        sizes = {"time_step_bar": bar.of.parameters["time_step"]}
        known = (bars, sizes, self._bars.named, self._at, *self._known(step))
        step.launch(self._springs.read.adjoint, *known, threads=self._threads)
        self._bars.add(self._spring, bar.of)


def spring_loads(solver: ParticleSolver) -> dict[str, QuantityFormula]:
    return {load_name(spring.name): SpringLoads(springs, spring) for springs, spring in springs_in(solver)}


@fixed
class SpringForce(Summed):
    """A sensor of the force and the length of a spring.

    The force is positive if the spring pulls and negative if the spring pushes. The force includes the damper, with the
    velocities of the end points in the step after the state.

    Example: ``run = simulation.run(100, sensors={"line": cortado.sensors.SpringForce("line")})``
    """

    def __init__(self, spring: str):
        """Measure the spring with the name ``spring``."""
        self.spring = named("spring", spring, "spring")

    def columns(self, dimension: int) -> dict[str, str]:
        return {"force": "N" if dimension == 3 else "N/m", "length": "m"}

    def summed(self, at: SensedScene) -> LoadSum:
        return LoadSum(load_name(self.spring))

    def reading(self, at: Reading, found: NDArray[Any]) -> NDArray[Any]:
        return found[..., :2]

    def adjoint(self, at: Reading, bar: NDArray[Any]) -> dict[str, NDArray[Any]]:
        return {load_name(self.spring): np.pad(bar, (0, 4 if at.dimension == 3 else 1))}


@fixed
class BodyMotion(Summed):
    """A sensor of the motion of a free body: the position of its middle, its rotation, velocity and angular velocity.

    The rotation is an angle in 2-D and a rotation vector in 3-D, of at most half a turn. At half a turn the value jumps
    by a whole turn, but the derivative is continuous.

    Example: ``run = simulation.run(100, sensors={"raft": cortado.sensors.BodyMotion("raft")})``
    """

    def __init__(self, solid: str):
        """Measure the free body with the name ``solid``."""
        self.solid = named("solid", solid, "solid")

    def columns(self, dimension: int) -> dict[str, str]:
        axes = "xyz"[:dimension]
        turns = [""] if dimension == 2 else [f"_{axis}" for axis in axes]
        found = dict.fromkeys(axes, "m") | {f"rotation{turn}": "rad" for turn in turns}
        found |= {f"velocity_{axis}": "m/s" for axis in axes}
        return found | {f"angular_velocity{turn}": "rad/s" for turn in turns}

    def summed(self, at: SensedScene) -> LoadSum:
        free = [table.name for table in at.solids if table.motion == "free"]
        if self.solid not in free:
            wanted = f"the name of a free body, one of {shown(free)}" if free else "in a scene with free bodies"
            raise InputError(f"solid is {shown(self.solid)}, but must be {wanted}.")
        return LoadSum()

    def reading(self, at: Reading, found: NDArray[Any]) -> NDArray[Any]:
        pose = self._pose(at)
        fast = (at[name(self.solid)].ravel() for name in (velocity_name, angular_velocity_name))
        return np.concatenate([pose.position, pose.angles, *fast])

    def adjoint(self, at: Reading, bar: NDArray[Any]) -> dict[str, NDArray[Any]]:
        pose, d, turns = self._pose(at), at.dimension, 2 * at.dimension - 3
        position, rotation, velocity, spin = np.split(bar, np.cumsum([d, turns, d]))
        bars = {position_name(self.solid): position[None], velocity_name(self.solid): velocity[None]}
        bars |= {angular_velocity_name(self.solid): spin if turns == 1 else spin[None]}
        return bars | pose.angle_bars(rotation)

    def _pose(self, at: Reading) -> Pose:
        self.summed(at)
        return Pose.of(self.solid, True, at)
