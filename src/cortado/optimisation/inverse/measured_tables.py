"""The tables [[problem.measured]] of a task: what was measured of an experiment."""

from typing import Annotated, Literal

from pydantic import Field

from cortado.scene.fields import Text, components, count, quantity
from cortado.scene.tables import Table

Pixel = Annotated[int, count(0, 100_000)]
Seconds = Annotated[float, quantity("s")]
Clock = tuple[Literal["start"], ...]


class MeasuredTable(Table):
    """Something that was measured."""

    name: Text
    """What it is called in results; its camera's parameters begin with it, as "camera.rotation"."""
    file: Text
    """Beside the task's own file: where the numbers are."""
    start: Seconds = 0.0
    """What the clock of the run shows where that of the file shows 0."""


class VideoTable(MeasuredTable):
    """Frames of a video, beside pictures of the simulation, whose camera [render] describes."""

    kind: Literal["video"]
    """Frames, compared with pictures."""
    frame_rate: Annotated[float, quantity("1/s", gt=0.0)] | None = None
    """Frames in a second; needed for a folder of pictures, what the video itself says if left out."""
    every: Annotated[int, count(1, 1_000_000)] = 1
    """Take only every so many frames."""
    crop: Annotated[tuple[Pixel, ...], components("left", "top", "right", "bottom")] | None = None
    """The part of each frame that counts, in its pixels; all of it if left out."""
    mask: Text | None = None
    """A picture of the frames' size, beside the task's own file, black where pixels do not count."""
    calibrate: tuple[Literal["start", "translation", "rotation", "field_of_view", "width", "extinction"], ...] = ()
    """What of the camera, the fluid's extinction, and the clock is searched beside the parameters; "start" is the key
    start."""
    noise: Annotated[float, quantity(gt=0.0)] | None = None
    """Standard deviation of the linear light of a pixel; the residuals tell if left out."""


class SensorSeriesTable(MeasuredTable):
    """What a sensor measured: a CSV file with a column "time" [s], and columns by the names of the sensor's numbers."""

    kind: Literal["sensor"]
    """A series, compared with a [[sensor]] of the scene; heights of a surface are those of a "wave_gauge"."""
    sensor: Text
    """The name of the [[sensor]]."""
    calibrate: Clock = ()
    """["start"] to search the key start beside the parameters."""
    noise: Annotated[float, quantity(gt=0.0)] | None = None
    """Standard deviation of a number, in its unit; the residuals tell if left out."""


class TracksTable(MeasuredTable):
    """Paths of tracers: a CSV file with columns "time" [s], "tracer" (a number), "x", "y" and in 3-D "z" [m]. Each
    tracer needs a line for the start of the run."""

    kind: Literal["tracks"]
    """Tracers, which swim with the fluid around them."""
    calibrate: Clock = ()
    """["start"] to search the key start beside the parameters."""
    noise: Annotated[float, quantity("m", gt=0.0)] | None = None
    """Standard deviation of a coordinate [m]; the residuals tell if left out."""


AnyMeasured = Annotated[VideoTable | SensorSeriesTable | TracksTable, Field(discriminator="kind")]
