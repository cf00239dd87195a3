"""The tables of a scene, and how an error in one becomes a sentence.

A wrong value ends in a `SceneError`, whether the scene comes from a file or is built in Python.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from difflib import get_close_matches
from typing import Any, ClassVar, Self

from pydantic import BaseModel, ConfigDict, ValidationError, model_validator
from pydantic_core import PydanticCustomError

from cortado.errors import LONGEST, SceneError, Words, shown
from cortado.scene.fields import MISSING, Components, FieldPath, FieldType, field_error

SHAPES = ("box", "cylinder", "sphere", "points", "none")


class Table(BaseModel):
    """A table of the scene: frozen, without unknown keys, and with a `SceneError` for whatever is wrong."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    beside: ClassVar[tuple[str, ...]] = ()
    """Tables of others that a file may hold beside its keys; only for advice."""

    def __init__(self, /, **data: Any):
        with sentences():
            super().__init__(**data)

    # Tells pydantic to build nested tables without this method, so that an error carries its whole path.
    __init__.__pydantic_base_init__ = True  # type: ignore[attr-defined]

    @model_validator(mode="before")
    @classmethod
    def _check_keys(cls, data: Any) -> Any:
        if isinstance(data, cls):
            return data
        if not isinstance(data, Mapping):
            raise field_error((), data, "a table")
        for key in data:
            if key not in cls.model_fields:
                raise _unknown_key(str(key), [*cls.model_fields, *(name for name in cls.beside if name != key)])
        for name, field in cls.model_fields.items():
            if field.is_required() and name not in data:
                wanted = [one.wanted for one in field.metadata if isinstance(one, FieldType)]
                raise field_error((name,), MISSING, wanted[0] if wanted else "a table")
        return data

    def in_dimension(self, dimension: int, path: FieldPath = ()) -> Self:
        """This table, at a path, with its vectors checked, and those left out filled in, for 2 or 3 dimensions."""
        filled = {}
        for name, field in type(self).model_fields.items():
            for field_type in field.metadata:
                if isinstance(field_type, Components):
                    filled[name] = field_type.in_dimension((*path, name), getattr(self, name), dimension)
        return self.model_copy(update=filled)


def _unknown_key(key: str, known: list[str]) -> PydanticCustomError:
    close = get_close_matches(key, known, n=1)
    advice = f"did you mean {close[0]}?" if close else f"its keys are {', '.join(known)}."
    return field_error((key,), Words("unknown"), f"one of {', '.join(known)}", f"is not a key of {{table}}; {advice}")


# ---- sentences ---------------------------------------------------------------------------------------------------


@contextmanager
def sentences() -> Iterator[None]:
    """Turn the first error that pydantic reports into a `SceneError`."""
    try:
        yield
    except ValidationError as error:
        raise _scene_error(error) from None


def field_name(path: FieldPath) -> str:
    """``("fluid", 0, "upper")`` as ``fluid[0].upper``."""
    text = ""
    for part in path:
        if isinstance(part, int):
            text += f"[{part}]"
        else:
            name = part if part.replace("-", "_").isidentifier() and len(part) < LONGEST else shown(part)
            text += f".{name}" if text else name
    return text


def _scene_error(error: ValidationError) -> SceneError:
    first = error.errors(include_url=False)[0]
    path = [part for part in first["loc"] if part not in SHAPES]  # pydantic names the member of a union
    if first["type"] != "scene":
        return SceneError(None, field_name(path), first["input"], f"valid ({first['msg']})")
    own = first["ctx"]["error"]
    path += own.path
    sentence = own.sentence
    if sentence:
        sentence = sentence.replace("{table}", f"[{field_name(path[:-1])}]" if path[1:] else "the scene")
    return SceneError(None, field_name(path), own.found, own.wanted, sentence)
