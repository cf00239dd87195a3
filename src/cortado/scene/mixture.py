"""How the phases of a scene mix, or stay apart."""

from typing import Annotated, Literal

from cortado.scene.fields import quantity
from cortado.scene.tables import Table


class MixtureTable(Table):
    """The Cahn-Hilliard equation that the mass fractions follow (Yang et al. 2015); the scene's phases, in order."""

    free_energy: Literal["double_well", "miscible"] = "double_well"
    """"double_well": phases separate, into pure ones; "miscible": they mix, by Fick's law."""
    strength: Annotated[float, quantity(gt=0.0)] = 1.0
    """Factor of the free energy, alpha."""
    mobility: Annotated[float, quantity("m2/s", ge=0.0)] = 0.0
    """How fast phases diffuse, M [m2/s]; at 0 nothing diffuses, and each particle keeps its phase."""
    mobility_form: Literal["degenerate", "constant"] = "degenerate"
    """"degenerate": phases exchange only where they touch; "constant": everywhere alike."""
    interface_width: Annotated[float, quantity("m", gt=0.0)] | None = None
    """Width of an interface, epsilon [m]; one spacing if left out. From 10 % to 90 % it is 4.39 epsilon / sqrt(alpha)
    wide."""

    def width(self, spacing: float) -> float:
        """The interface width [m] of a scene of a spacing [m]."""
        return spacing if self.interface_width is None else self.interface_width
