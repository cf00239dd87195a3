"""What materials look like in pictures, a line for each. How a fluid flows and what a solid weighs is not their matter.

Colours are linear, from 0 to 1.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

from pydantic import SerializationInfo, field_serializer, model_validator

from cortado.scene.fields import Colour
from cortado.scene.tables import Table

Numbers = tuple[float, ...]


@dataclass(frozen=True)
class Liquid:
    """Fluid in pictures: on a way L within it light is taken away by Beer and Lambert's law."""

    colour: Numbers
    """Of light that it scatters, and of white light that has gone 1 / absorption through it."""
    scattering: float
    """[1/m]: the part exp(-scattering L) of the light goes straight on."""
    absorption: float
    """[1/m]: of that, the part colour^(absorption L) is left."""


@dataclass(frozen=True)
class Finish:
    """A surface of a solid, or of the walls of a container."""

    colour: Numbers
    transparency: float = 0.0
    """The part of the light that goes through."""
    reflectivity: float = 0.0
    """The part of the light that it reflects as a mirror in its colour does."""


LIQUIDS = {
    "water": Liquid(colour=(0.10, 0.35, 0.65), scattering=0.02, absorption=0.15),
    "milk": Liquid(colour=(0.93, 0.90, 0.83), scattering=1500.0, absorption=100.0),
    "coffee": Liquid(colour=(0.12, 0.035, 0.008), scattering=30.0, absorption=50.0),
    "honey": Liquid(colour=(0.80, 0.36, 0.03), scattering=3.0, absorption=25.0),
    "oil": Liquid(colour=(0.80, 0.62, 0.08), scattering=1.0, absorption=15.0),
}
"""What phases may be made of, by name."""
FINISHES = {
    "glass": Finish(colour=(0.72, 0.86, 0.82), transparency=0.92),
    "steel": Finish(colour=(0.62, 0.61, 0.59), reflectivity=0.75),
}
"""What solids and containers may be made of, by name."""


class Coloured(Table):
    """A table with a colour: its own, if one is given, or that of its material, or else a plain one."""

    materials: ClassVar[Mapping[str, Any]]
    plain: ClassVar[Numbers]

    @model_validator(mode="after")
    def _take_colour(self) -> Self:
        own: Any = self
        if own.colour is None:
            self.__dict__["colour"] = self.plain if own.material is None else self.materials[own.material].colour
            self.model_fields_set.discard("colour")
        return self

    @field_serializer("colour", check_fields=False)
    def _given_colour(self, colour: Colour, info: SerializationInfo) -> Colour | None:
        """None where it was not given, unless the context asks for all `colours`: another material has another."""
        return colour if "colour" in self.model_fields_set or info.context == "colours" else None
