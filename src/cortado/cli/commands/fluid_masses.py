"""How much of each phase a scene holds, and how much it was asked to hold."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

from cortado.discretise.shapes import EXCESS
from cortado.scene.sampling import asked_volumes
from cortado.simulation import Simulation


@dataclass(frozen=True)
class FluidMasses:
    """By phase [kg]; in 2-D of a layer one metre thick."""

    given: Mapping[str, float]
    """That of its particles at the start, with those that wait in an emitter."""
    asked: Mapping[str, float]
    """That of the volume that its bodies of fluid have, and what an emitter holds."""

    @classmethod
    def of(cls, simulation: Simulation) -> Self:
        """Of the fluid at the start."""
        scene = simulation.scene
        held = simulation.lattice.cell * simulation.mass_fractions.sum(axis=0)
        wanted = asked_volumes(scene)
        if scene.emitter is not None:
            waiting = simulation.particles - simulation.free_particles
            wanted[scene.emitter.phase] += waiting * simulation.lattice.cell
        given = {
            phase.name: float(phase.rest_density * volume) for phase, volume in zip(scene.phase, held, strict=True)
        }
        return cls(given, {phase.name: phase.rest_density * wanted[phase.name] for phase in scene.phase})

    @property
    def off(self) -> dict[str, str]:
        """In words, of phases that hold another mass than was asked for, by more than `EXCESS`."""
        return {
            name: f"{given:.4g} kg of {name}, where {self.asked[name]:.4g} kg were asked for"
            for name, given in self.given.items()
            if abs(given - self.asked[name]) > EXCESS * self.asked[name]
        }
