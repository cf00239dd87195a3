"""How much of each phase a scene holds, and how much it was asked to hold."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

import numpy as np

from cortado.discretise.shapes import EXCESS
from cortado.scene.sampling import FluidSample
from cortado.scene.scene import Scene


@dataclass(frozen=True)
class FluidMasses:
    """By phase [kg]; in 2-D of a layer one metre thick."""

    given: Mapping[str, float]
    """That of its particles at the start, with those that wait in an emitter."""
    asked: Mapping[str, float]
    """That of the volume that its bodies of fluid have, without what walls take of it, and what an emitter holds."""

    @classmethod
    def of(cls, scene: Scene, fluid: FluidSample) -> Self:
        """Of the first particles of a scene."""
        names, cell = [phase.name for phase in scene.phase], scene.discretisation.spacing**scene.dimension
        densities = np.array([phase.rest_density for phase in scene.phase])
        held = cell * np.bincount(fluid.phase, minlength=len(names))
        waiting = cell * np.bincount(fluid.phase[fluid.emitted], minlength=len(names))
        bodies = [names.index(body.phase) for body in scene.fluid]
        wanted = waiting + np.bincount(bodies, fluid.asked, minlength=len(names))
        given, asked = ((densities * volumes).tolist() for volumes in (held, wanted))
        return cls(dict(zip(names, given, strict=True)), dict(zip(names, asked, strict=True)))

    @property
    def off(self) -> dict[str, str]:
        """In words, of phases that hold another mass than was asked for, by more than `EXCESS`."""
        return {
            name: f"{given:.4g} kg of {name}, where {self.asked[name]:.4g} kg were asked for"
            for name, given in self.given.items()
            if abs(given - self.asked[name]) > EXCESS * self.asked[name]
        }

    @property
    def warning(self) -> str | None:
        """What to say of a scene before it runs; None where all phases hold what was asked for."""
        if not self.off:
            return None
        return (
            f"the fluid begins with {' and '.join(self.off.values())}: boxes whose sides are whole multiples of the "
            "spacing have exactly what is asked for, and of other shapes a smaller spacing comes nearer."
        )
