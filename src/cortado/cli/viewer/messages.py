"""What may be said to a window of ``cortado view``: where the camera is, and values that its controls can have.

viser takes any value of any attribute of a control, and does more that no window here has, such as a tunnel to the
internet. Everything but the messages below is left aside.
"""

import math
from collections.abc import Callable
from contextlib import suppress
from typing import Annotated, Any

import msgspec
import viser

LARGEST = 1e9
"""Of a number of the camera."""
LONGEST = 2**16
"""Bytes of a message; those of viser's page have some hundreds."""
Number = Annotated[float, msgspec.Meta(ge=-LARGEST, le=LARGEST)]
Direction = tuple[Number, Number, Number]
Controls = Callable[[str], Any]
"""A control by its id; None where there is none."""


class CameraMessage(msgspec.Struct, tag_field="type", tag="ViewerCameraMessage", forbid_unknown_fields=True):
    """Where the camera of a page is; viser calls a page connected from the first one on."""

    wxyz: tuple[Number, Number, Number, Number]
    position: Direction
    fov: Number
    near: Number
    far: Number
    image_height: Number
    image_width: Number
    look_at: Direction
    up_direction: Direction


class Update(msgspec.Struct, tag_field="type", tag="GuiUpdateMessage", forbid_unknown_fields=True):
    """What a control is set to."""

    uuid: str
    updates: dict[str, Any]


_decoder = msgspec.msgpack.Decoder(CameraMessage | Update)
_encoder = msgspec.msgpack.Encoder()


def judged(message: bytes | str, controls: Controls) -> bytes | None:
    """A message as viser may read it, written again so that both read the same; None for one to be left aside."""
    with suppress(msgspec.MsgspecError, RecursionError, TypeError):
        said = _decoder.decode(message)  # type: ignore[arg-type]  # a text is refused
        if isinstance(said, CameraMessage) or (said.updates.keys() == {"value"} and _can_be(said, controls)):
            return _encoder.encode(said)
    return None


def _can_be(said: Update, controls: Controls) -> bool:
    """Whether the page lets its user set a control to this value."""
    control, value = controls(said.uuid), said.updates["value"]
    if control is None or control.disabled or not control.visible:
        return False
    match control:
        case viser.GuiButtonHandle():
            return value is True
        case viser.GuiCheckboxHandle():
            return isinstance(value, bool)
        case viser.GuiDropdownHandle():
            return isinstance(value, str) and value in control.options
        case viser.GuiSliderHandle():
            return _is_between(control, value)
    return False


def _is_between(slider: Any, value: Any) -> bool:
    """Whether a number is within a slider's ends, which the page rounds to the digits that it shows."""
    if isinstance(value, bool) or not isinstance(value, type(slider.value) | int):
        return False
    slack = 0.5 * 10.0**-slider.precision if isinstance(slider.value, float) else 0
    return math.isfinite(value) and slider.min - slack <= value <= slider.max + slack
