"""What all tables of a scene have in common.

A wrong value ends in a `SceneError`, whether the scene comes from a file or is built in Python.
"""

from collections.abc import Iterable, Mapping
from difflib import get_close_matches
from typing import Any, ClassVar, Self

from pydantic import BaseModel, ConfigDict, GetJsonSchemaHandler, model_validator
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema, PydanticCustomError

from cortado.errors import InputError, Words
from cortado.scene.docstrings import field_docstrings
from cortado.scene.fields import PER_AXIS, FieldPath, field_error, without_numpy
from cortado.scene.sentences import UNKNOWN, sentences

ALSO_CALLED = {
    **dict.fromkeys(("dt", "step_size"), ("time_step",)),
    **dict.fromkeys(("dx", "h", "particle_size", "particle_radius", "resolution"), ("spacing",)),
    **dict.fromkeys(("walls", "boundary", "boundaries", "box", "domain", "tank"), ("container",)),
    **dict.fromkeys(("obstacle", "obstacles", "body", "rigid_body"), ("solid",)),
    **dict.fromkeys(("fluids", "liquid", "water"), ("phase", "fluid")),
    **dict.fromkeys(("rho", "mass"), ("rest_density", "density")),
    **dict.fromkeys(("mu", "eta"), ("viscosity",)),
    **dict.fromkeys(("speed", "flow", "rate"), ("velocity", "flow_rate")),
    **dict.fromkeys(("lr", "step"), ("learning_rate",)),
    **dict.fromkeys(("epochs", "maxiter", "updates"), ("iterations",)),
    **dict.fromkeys(("method", "algorithm"), ("optimiser",)),
    **dict.fromkeys(("initial", "guess"), ("start",)),
    **dict.fromkeys(("min", "from"), ("lower",)),
    **dict.fromkeys(("max", "to", "size"), ("upper",)),
    **{"type": ("kind", "shape"), "n": ("flow_index",), "cfl": ("courant",), "omega": ("angular_velocity",)},
    **{"angle": ("rotation",), "csv": ("file",), "path": ("file",), "fps": ("frame_rate",)},
}
"""Keys by what others call them."""


class Table(BaseModel):
    """A table of the scene: frozen, without unknown keys, and with a `SceneError` for whatever is wrong."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    beside: ClassVar[tuple[str, ...]] = ()
    """Tables of others that a file may hold beside its keys; only for advice."""

    def __init__(self, /, **data: Any):
        with sentences(type(self)):
            super().__init__(**data)

    def __setattr__(self, name: str, value: Any) -> None:
        raise InputError(
            f"{name} cannot be set, as a scene does not change; make another one, such as "
            'scene.replaced("solver.time_step=0.001").'
        )

    # Tells pydantic to build nested tables without this method, so that an error carries its whole path.
    __init__.__pydantic_base_init__ = True  # type: ignore[attr-defined]

    @model_validator(mode="before")
    @classmethod
    def _check_keys(cls, data: Any) -> Any:
        if not isinstance(data, Mapping):
            return data
        for key in data:
            if key not in cls.model_fields:
                raise _unknown_key(str(key), [*cls.model_fields, *(name for name in cls.beside if name != key)])
        return {name: without_numpy(value) for name, value in data.items()}

    @classmethod
    def __get_pydantic_json_schema__(cls, core_schema: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        """With the docstrings of fields as their descriptions."""
        schema = handler(core_schema)
        properties = handler.resolve_ref_schema(schema).get("properties", {})
        texts = field_docstrings(cls)
        for name in properties.keys() & texts.keys():
            properties[name].setdefault("description", texts[name])
        return schema

    def in_dimension(self, dimension: int, path: FieldPath = ()) -> Self:
        """This table, at a path, with its vectors checked, and those left out filled in, for 2 or 3 dimensions."""
        filled = {}
        for name, field in type(self).model_fields.items():
            if PER_AXIS in field.metadata:
                value = getattr(self, name)
                filled[name] = value if name in self.model_fields_set else value[:dimension]
                if len(filled[name]) != dimension:
                    raise components_error((*path, name), value, dimension)
        return self.model_copy(update=filled)

    def check_components(self, names: Iterable[str], dimension: int, path: FieldPath) -> None:
        """Those fields of these names that are there and given have as many components as there are dimensions."""
        for name in names:
            value = getattr(self, name, None)
            if value is not None and len(value) != dimension:
                raise components_error((*path, name), value, dimension)


def components_error(path: FieldPath, value: Any, dimension: int) -> PydanticCustomError:
    """What is raised of a vector that has another number of components."""
    wanted = f"a list of {dimension} components, as the scene has {dimension} dimensions"
    return field_error(path, value, wanted)


def _unknown_key(key: str, known: list[str]) -> PydanticCustomError:
    longer = [name for name in known if key in name.split("_")]
    other = [name for name in ALSO_CALLED.get(key.lower(), ()) if name in known]
    close = other or longer or get_close_matches(key, known, n=1)
    advice = f"did you mean {close[0]}?" if close else f"its keys are {', '.join(known)}."
    found = Words("short for another") if longer else UNKNOWN
    return field_error((key,), found, f"one of {', '.join(known)}", f"is not a key of {{table}}; {advice}")
