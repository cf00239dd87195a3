"""The key ``rheology`` of a phase: how its viscosity follows from the shear rate (`cortado.sph.viscosity_law`)."""

from typing import Annotated, Any, Literal

from pydantic import Field

from cortado.scene.fields import quantity
from cortado.scene.tables import Table

SHORTEST = 40.0
"""Regularisation [s] that a fluid with a yield stress has at least, if it is not given: what does not yield creeps at
2.5 % of its depth in a second at most. Beside a longer one the edge of a plug is less sharp than 40 particles across
resolve: its speed between plates is off by 0.8 % with 40 s, by 2.7 % with 100 s."""


class RheologyTable(Table):
    """A law of viscosity; its numbers are parameters, such as ``carreau.flow_index``."""

    kind: str
    """Name of the law."""

    def numbers(self, viscosity: float) -> dict[str, float]:
        """The parameters of the law, for the viscosity of the phase [Pa s]."""
        return {name: value for name, value in self.model_dump().items() if name != "kind"}

    def thickest(self, viscosity: float) -> float:
        """The greatest viscosity of the fluid [Pa s], for that of the phase."""
        return viscosity


class Thinning(RheologyTable):
    """What laws with a power of the shear rate have in common."""

    flow_index: Annotated[float, quantity(gt=0.0, le=3.0)]
    """n [-]: below 1 the fluid gets thinner where it is sheared, above 1 thicker."""
    least_shear_rate: Annotated[float, quantity("1/s", gt=0.0)] = 0.01
    """Added to the shear rate in squares [1/s], so that the viscosity at rest is finite."""

    def thickest(self, viscosity: float) -> float:
        return viscosity * max(self.least_shear_rate ** (self.flow_index - 1.0), 1.0)


class PowerLaw(Thinning):
    """eta = viscosity (shear rate)^(flow_index - 1), of Ostwald and de Waele: viscosity is the consistency, which is
    that at a shear rate of 1/s."""

    kind: Literal["power_law"] = "power_law"
    """Name of the law."""


class Carreau(RheologyTable):
    """eta = infinite_viscosity + (viscosity - infinite_viscosity) (1 + (relaxation_time shear rate)^2)^((flow_index -
    1) / 2), of Carreau (1972): viscosity is that at rest."""

    kind: Literal["carreau"] = "carreau"
    """Name of the law."""
    relaxation_time: Annotated[float, quantity("s", ge=0.0)]
    """lambda [s]: the viscosity changes at shear rates beyond 1 / lambda."""
    flow_index: Annotated[float, quantity(gt=0.0, le=3.0)]
    """n [-]."""
    infinite_viscosity: Annotated[float, quantity("Pa s", ge=0.0)] = 0.0
    """The viscosity at a large shear rate [Pa s]."""

    def thickest(self, viscosity: float) -> float:
        return max(viscosity, self.infinite_viscosity)


class Yielding(RheologyTable):
    """What laws with a yield stress have in common."""

    yield_stress: Annotated[float, quantity("Pa", ge=0.0)]
    """Below it the fluid hardly flows [Pa]."""
    regularisation: Annotated[float, quantity("s", gt=0.0)] | None = None
    """m of Papanastasiou (1987) [s]: at rest the viscosity is finite, yield_stress m more, so that fluid which does not
    yield creeps, at its depth / m at most; the longer of 40 s and 100 viscosity / yield_stress if left out."""

    def numbers(self, viscosity: float) -> dict[str, float]:
        growth = self.regularisation
        if growth is None:
            growth = max(100.0 * viscosity / self.yield_stress if self.yield_stress > 0.0 else 0.0, SHORTEST)
        return {**super().numbers(viscosity), "regularisation": growth}

    def thickest(self, viscosity: float) -> float:
        return super().thickest(viscosity) + self.yield_stress * self.numbers(viscosity)["regularisation"]


class Bingham(Yielding):
    """eta = viscosity + yield_stress (1 - exp(-m shear rate)) / shear rate, of Bingham, as Papanastasiou (1987) makes
    it smooth: viscosity is that of the fluid once it flows."""

    kind: Literal["bingham"] = "bingham"
    """Name of the law."""


class HerschelBulkley(Yielding, Thinning):
    """The sum of a power law and of a yield stress, as of Bingham's: viscosity is the consistency."""

    kind: Literal["herschel_bulkley"] = "herschel_bulkley"
    """Name of the law."""


AnyRheology = Annotated[PowerLaw | Carreau | Bingham | HerschelBulkley, Field(discriminator="kind")]
"""A law of viscosity by its ``kind``."""


def greatest_viscosity(phase: Any, viscosity: float) -> float:
    """Of a phase [Pa s], for what its key viscosity, or a parameter in its place, says [Pa s]."""
    return viscosity if phase.rheology is None else float(phase.rheology.thickest(viscosity))
