"""The field types of parameters by name, and of names of parameters, in the tables of a task."""

from collections.abc import Collection, Mapping
from functools import partial
from typing import Annotated, Any

import numpy as np
from pydantic import BeforeValidator, ValidationInfo, ValidatorFunctionWrapHandler, WithJsonSchema, WrapValidator

from cortado.errors import Words
from cortado.scene.fields import OneOf, as_number, field_error
from cortado.scene.parameter_values import NAMES, UNITS
from cortado.scene.tables import wanted

RANDOM = "random"
CAN_BE_RANDOM = ("initial_positions", "mass_fractions")


def _arrays(values: Any, info: ValidationInfo, words: tuple[str, ...] = ()) -> dict[str, Any]:
    """Values by name as arrays, or as one of the words where a parameter can be random; raises a `field_error`."""
    if not isinstance(values, Mapping) or not values:
        raise field_error((), Words("empty") if values == {} else values, wanted(VALUES))
    found = {}
    names = _names(info)
    for name, value in _flat(values, names).items():
        if name not in names:
            raise field_error((name,), Words("unknown"), _offered(info))
        is_word = name in CAN_BE_RANDOM and isinstance(value, str) and value in words
        found[name] = value if is_word else _array(name, value)
    return found


def _flat(values: Mapping[str, Any], names: Collection[str]) -> dict[str, Any]:
    """Values by name, where ``drag.k = 2.0`` is a table in a table."""
    found = {}
    for name, value in values.items():
        deeper = isinstance(value, Mapping) and any(known.startswith(f"{name}.") for known in names)
        found.update({f"{name}.{key}": entry for key, entry in value.items()} if deeper else {name: value})
    return found


def _names(info: ValidationInfo) -> Collection[str]:
    """Of all parameters, those of parts of packages among them where whoever reads the tables says which."""
    return (*NAMES, *(info.context or {}).get("names", ()))


def _offered(info: ValidationInfo) -> str:
    """Which names are right: of parameters that the scene has, where whoever reads the tables says which."""
    return f"one of {', '.join((info.context or {}).get('names', NAMES))}"


def _known(name: Any, check: ValidatorFunctionWrapHandler, info: ValidationInfo) -> Any:
    """The name of a parameter; raises a `field_error` where whoever reads the tables says which names are right."""
    if info.context and name not in _names(info):
        raise field_error((), name, _offered(info))
    return name if info.context else check(name)


def _array(name: str, value: Any) -> Any:
    finite = "made of finite numbers: one, a list of them, or a list of lists of one length"
    if not _is_numeric(value):
        raise field_error((name,), value, finite)
    try:
        return np.array(value, dtype=np.float64)
    except ValueError:
        raise field_error((name,), value, finite) from None


def _is_numeric(value: Any) -> bool:
    """Whether there is a finite number, or nothing else in a list that is not empty."""
    if isinstance(value, list):
        return bool(value) and all(map(_is_numeric, value))
    return as_number(value) is not None


_NUMBERS: list[Any] = [{"type": "number"}, {"type": "array"}]


def _schema(words: tuple[str, ...] = ()) -> dict[str, Any]:
    """The JSON schema of values by name; parameters that can be random may be one of the words too."""
    allowed = [{"enum": list(words)}] if words else []
    properties = {
        name: {"anyOf": [*_NUMBERS, *allowed] if name in CAN_BE_RANDOM else _NUMBERS, "unit": unit or "-"}
        for name, unit in UNITS.items()
    }
    dotted = {r"\.": {"anyOf": _NUMBERS, "unit": "-"}}  # of parts of packages, also written as tables
    others = {"patternProperties": dotted, "additionalProperties": {"type": "object"}}
    return {"type": "object", "minProperties": 1, "properties": properties, **others}


VALUES = _schema()
"""The JSON schema of `Values`."""
Values = Annotated[dict[str, Any], BeforeValidator(_arrays), WithJsonSchema(VALUES)]
"""Parameters by name, each a number, a list of numbers, or a list of lists of numbers."""
Start = Annotated[
    dict[str, Any], BeforeValidator(partial(_arrays, words=(RANDOM,))), WithJsonSchema(_schema(words=(RANDOM,)))
]
"""Values, of which some may be the word "random"."""
ParameterName = Annotated[str, OneOf(NAMES), WrapValidator(_known)]
"""Of a parameter of Cortado, or of a part of a package where whoever reads the tables knows it."""
