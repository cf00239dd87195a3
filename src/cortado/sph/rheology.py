"""Generalised Newtonian fluids: viscosity as a stress with a law that is one function of a user's."""

from typing import Any

import numpy as np

from cortado.device.precision import Precision
from cortado.errors import InputError
from cortado.particles.state import padded
from cortado.scene.parameter_values import Arrays
from cortado.scene.scene import Scene
from cortado.sph.implicit_viscosity import stress_of
from cortado.sph.own_force import OverTime, OwnFunction, topic
from cortado.sph.parts import Setting
from cortado.sph.viscosity_law import Law, check_law
from cortado.sph.viscous_stress import ViscousStress


class Rheology(OwnFunction):
    """A law of viscosity: ``function(shear_rate, viscosity, ...)`` returns the viscosity [Pa s] at a shear rate
    sqrt(2 D : D) [1/s], where ``viscosity`` [Pa s] is that of the phase and D the symmetric velocity gradient. It takes
    the place of the viscous force of a scene, whose viscosity is "stress"."""

    kind = "Rheology"
    replaces = "cortado.sph.viscosity"
    """The module of the scene's force that does not act beside it."""

    def force(self, setting: Setting) -> ViscousStress:
        """Make the viscous force with this law; raise `InputError` for a function that Warp cannot compile, or that
        returns a viscosity that is negative or not finite."""
        check_form(setting.scene)
        made = stress_of(setting.scene)(setting, self._law(setting.scene), self.parameters)
        made.compile(self._what)
        self._try({}, setting.scene, setting.layout.precision, setting.layout.device)
        return made

    def check(self, values: Arrays, simulation: Any) -> None:
        """Raise `InputError` where the law returns no valid viscosity with these values of parameters, by name."""
        if "viscosity" in values or any(one.name in values for one in self.parameters):
            self._try(values, simulation.scene, simulation.precision, simulation.device)

    @property
    def _what(self) -> str:
        return f"{self.kind} function {self._formula.name}"

    def _law(self, scene: Scene) -> Law:
        ranks = tuple(p.rank for p in self.parameters)
        return Law(self._formula, ranks, topic("rheology", self._formula, ranks, scene.dimension) + "_")

    def _try(self, values: Arrays, scene: Scene, precision: Precision, device: Any) -> None:
        own = np.broadcast_to(values.get("viscosity", [phase.viscosity for phase in scene.phase]), len(scene.phase))
        viscosities = {phase.name: float(value) for phase, value in zip(scene.phase, own, strict=True)}
        size = values.get("time_step", scene.solver.time_step)
        thetas = self._thetas(values, 0.0 if isinstance(size, str) else float(size))
        check_law(self._what, self._law(scene), viscosities, thetas, precision, device)

    def _thetas(self, values: Arrays, time_step: float) -> np.ndarray:
        """Return the function's parameters (k, numbers) for these values at every time at which one changes: with a row
        for each step, at the beginning of each."""
        known = {one.name: one for one in self.parameters}
        own = {name: values.get(f"{self.name}.{name}", value) for name, value in self._values.items()}
        steps = max((len(v) for n, v in values.items() if n in known and v.ndim > known[n].rank), default=0)
        changes = [t for v in own.values() if isinstance(v, OverTime) for t in v.times]
        times = time_step * np.arange(steps) if steps else np.unique([0.0, *changes])
        columns = [times] if len(self._formula.inputs) == 3 else []
        for name, value in own.items():
            found = value.at(times) if isinstance(value, OverTime) else value
            is_vector = known[f"{self.name}.{name}"].rank
            rows = np.broadcast_to(found, (len(times), *found.shape[-1:] * is_vector))
            columns += [padded(rows) if is_vector else rows]
        return np.column_stack([np.zeros((len(times), 0)), *columns])


def check_form(scene: Scene) -> None:
    """Raise `InputError` for a scene whose viscous force is no stress."""
    if scene.forces.viscosity != "stress":
        found = f"forces.viscosity is {scene.forces.viscosity!r}"
        raise InputError(f"{found}, but must be 'stress' where the viscosity depends on the shear rate.")
