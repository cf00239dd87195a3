"""What the tables of solvers and forces have in common whose kind an installed package registers."""

from collections.abc import Collection, Mapping
from typing import Annotated, Any, ClassVar, Self

from pydantic import ConfigDict, GetJsonSchemaHandler, model_validator
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema

from cortado.errors import SceneError
from cortado.scene.entry_points import checked_keys, loaded, made, registered
from cortado.scene.fields import FieldPath, Text, field_error, without_numpy
from cortado.scene.parameters.registry import PARAMETERS
from cortado.scene.tables import Table


class PackageTable(Table):
    """A table whose kind an installed package registers. Its other keys are the arguments of what is registered."""

    model_config = ConfigDict(extra="allow")
    group: ClassVar[str]
    """Of entry points."""
    method: ClassVar[str]
    """That what is made has."""
    own: ClassVar[Collection[str]] = ()
    """Names that no package can have."""
    advice: ClassVar[str] = ""
    """What else may stand in the place of ``kind``, in words."""
    kind: Text
    """The name that the package gives it."""

    @model_validator(mode="before")
    @classmethod
    def _check_keys(cls, data: Any) -> Any:
        if not isinstance(data, Mapping) or not isinstance(data.get("kind"), str) or not data["kind"].strip():
            return data
        given = {str(name): without_numpy(value) for name, value in data.items()}
        common = {name: value for name, value in given.items() if name in cls.model_fields}
        others = {name: value for name, value in given.items() if name not in cls.model_fields}
        try:
            return {**common, **cls._judged(data["kind"], others)}
        except SceneError as error:
            sentence = None if error.wanted and error.sentence.startswith("is ") else error.sentence
            path = () if not error.field else (error.field,)
            raise field_error(path, error.found, error.wanted, sentence) from error

    @classmethod
    def _judged(cls, kind: str, keys: Mapping[str, Any]) -> dict[str, Any]:
        """The keys as the part takes them; raises a `SceneError` about one of them."""
        entry = registered(cls.group, kind, cls.own, cls.advice)
        factory = loaded(entry)
        checked = checked_keys(factory, keys, tuple(cls.model_fields))
        made(entry, factory, checked, cls.method)
        return checked

    def make(self) -> Any:
        """The part, as the package makes it of the keys; raises a `SceneError`."""
        entry = registered(self.group, self.kind, self.own, self.advice)
        return made(entry, loaded(entry), self.model_extra or {}, self.method)

    def in_dimension(self, dimension: int, path: FieldPath = ()) -> Self:
        return self


class Inline:
    """Has the JSON schema of a table stand where it is used, and not among the tables whose keys are all known."""

    def __get_pydantic_json_schema__(self, core_schema: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        return {"allOf": [handler.resolve_ref_schema(handler(core_schema))]}


class PackageForce(PackageTable):
    """A force that an installed package registers; there may be several."""

    group = "cortado.forces"
    method = "force"
    own = ("gravity", "viscosity", "pressure", *(p.name for p in PARAMETERS if p.is_optional))


AnyForces = tuple[Annotated[PackageForce, Inline()], ...]
