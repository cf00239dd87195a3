"""How pictures of a scene are taken."""

from typing import Annotated, Any, Literal, Self

from pydantic import Field, ValidationInfo, field_validator, model_validator

from cortado.scene.fields import MISSING, Colour, FieldPath, Length, components, count, field_error, quantity
from cortado.scene.tables import Table

Pixels = Annotated[tuple[Annotated[int, count(8, 4096)], ...], components("columns", "rows")]
Place = Annotated[tuple[Length, ...], components("x", "y", "z")]


class Render(Table):
    """The view, and for a view of the volume its camera."""

    view: Literal["top", "volume", "plane"] = "top"
    """"top": from above; "volume": through a camera; "plane": the plane itself, in 2-D, where it is the default."""
    resolution: Pixels = (128, 128)
    """(2,) columns and rows of pixels"""
    background: Colour = (1.0, 1.0, 1.0)
    """(3,) red, green and blue, each from 0 to 1"""
    extinction: Annotated[float, quantity("1/m", gt=0.0)] | None = None
    """How quickly light fades in fluid [1/m]; chosen by the renderer if left out."""
    position: Place | None = Field(default=None, validate_default=True)
    """(3,) where the camera is [m]; for a view of the volume, which needs it"""
    look_at: Place | None = Field(default=None, validate_default=True)
    """(3,) the middle of the picture [m]; for a view of the volume, which needs it"""
    field_of_view: Annotated[float, quantity("degrees", gt=0.0, le=170.0)] | None = Field(
        default=None, validate_default=True
    )
    """The angle that the width of the picture spans [degrees]; for a view of the volume, 40 if left out."""

    @field_validator("position", "look_at", "field_of_view")
    @classmethod
    def _check_camera(cls, value: Any, info: ValidationInfo) -> Any:
        view = info.data.get("view")
        if value is not None and view in ("top", "plane"):
            raise field_error((), value, f'left out, as the view is "{view}": only the view "volume" has a camera')
        if value is None and view == "volume":
            if info.field_name == "field_of_view":
                return 40.0
            raise field_error((), MISSING, 'a list of 3 components: x, y and z, as the view is "volume"')
        return value

    @model_validator(mode="after")
    def _check_direction(self) -> Self:
        if self.position is not None and self.position == self.look_at:
            raise field_error(("look_at",), self.look_at, "another place than position")
        return self

    def in_dimension(self, dimension: int, path: FieldPath = ()) -> Self:
        """This table, at a path, for 2 or 3 dimensions."""
        if dimension == 2 and "view" not in self.model_fields_set:
            return self.model_copy(update={"view": "plane"})
        if (self.view == "plane") != (dimension == 2):
            wanted = '"plane", as the scene has 2 dimensions' if dimension == 2 else '"top" or "volume" in 3-D'
            raise field_error((*path, "view"), self.view, wanted)
        return self
