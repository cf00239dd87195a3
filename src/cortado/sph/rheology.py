"""Generalised Newtonian fluids: viscosity as a stress with a law that is one function of a user's."""

import numpy as np

from cortado.errors import InputError
from cortado.particles.arrays import padded
from cortado.scene.scene import Scene
from cortado.sph.implicit_viscosity import stress_of
from cortado.sph.law_trial import check_law
from cortado.sph.own_force import OverTime, OwnFunction, topic
from cortado.sph.parts import Setting
from cortado.sph.viscosity_law import Law
from cortado.sph.viscous_stress import ViscousStress


class Rheology(OwnFunction):
    """A law of viscosity: ``function(shear_rate, viscosity, ...)`` returns the viscosity [Pa s] at a shear rate
    sqrt(2 D : D) [1/s], where ``viscosity`` [Pa s] is that of the phase and D the symmetric velocity gradient. It takes
    the place of the viscous force of a scene, whose viscosity is "stress"."""

    kind = "Rheology"
    replaces = "cortado.sph.viscosity"
    """The module of the scene's force that does not act beside it."""

    def force(self, setting: Setting) -> ViscousStress:
        """The viscous force with this law; raises `InputError` for a function that Warp cannot compile, or that returns
        a viscosity that is negative or not finite."""
        check_form(setting.scene)
        ranks = tuple(p.rank for p in self.parameters)
        law = Law(self._formula, ranks, topic("rheology", self._formula, ranks, setting.scene.dimension) + "_")
        made = stress_of(setting.scene)(setting, law, self.parameters)
        what, layout = f"{self.kind} function {self._formula.name}", setting.layout
        made.compile(what)
        viscosities = {phase.name: phase.viscosity for phase in setting.scene.phase}
        check_law(what, law, viscosities, self._thetas(), layout.precision, layout.device)
        return made

    def _thetas(self) -> np.ndarray:
        """(k, numbers) what the function's parameters are, at every time at which one of them changes."""
        times = np.unique([0.0, *(t for v in self._values.values() if isinstance(v, OverTime) for t in v.times)])
        columns = [times] if len(self._formula.inputs) == 3 else []
        for value in self._values.values():
            rows = value.at(times) if isinstance(value, OverTime) else np.stack([value] * len(times))
            columns += [padded(rows)] if rows.ndim == 2 else [rows]
        return np.column_stack([np.zeros((len(times), 0)), *columns])


def check_form(scene: Scene) -> None:
    """Raises `InputError` for a scene whose viscous force is no stress."""
    if scene.forces.viscosity != "stress":
        found = f"forces.viscosity is {scene.forces.viscosity!r}"
        raise InputError(f"{found}, but must be 'stress' where the viscosity depends on the shear rate.")
