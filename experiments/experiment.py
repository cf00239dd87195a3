"""An experiment: a type of experiment, which measures, draws and judges, with settings from a file."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Protocol

from cortado.files.terminal import Advance
from cortado.scene import tables
from cortado.scene.scene import Scene
from cortado.scene.tables import Text, components, quantity
from experiments.tables import Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Settings(tables.Table):
    """The settings in the file of an experiment; each type of experiment adds its own.

    Their field types are those of `cortado.scene.tables`, which make sentences of errors.
    """

    title: Text
    """The title of the picture."""

    def identity(self) -> dict[str, Any]:
        """The settings on which the measurement depends, for JSON; with the same ones it is not repeated."""
        return self.model_dump(mode="json")


class SceneSettings(Settings):
    """Settings of an experiment with a scene."""

    scene: Scene
    """In the file a path relative to it, or a table: its key ``file`` is such a path, everything else is put into that
    scene, as `experiments.scenes.varied` does; without ``file`` the table is a scene."""


class DeviceSettings(Settings):
    """Settings of an experiment that runs on a device; the others use the reference engine."""

    device: Text = "cpu"
    """"cpu", or "cuda:0" for the first GPU."""


Window = Annotated[tuple[Annotated[float, quantity("steps", ge=0.0)], ...], components("first", "last")]


class Progress(Protocol):
    """Shows the progress of a measurement: ``with progress(total) as advance: ... advance(n)``.

    The units of ``total`` and ``n`` are free, as long as each takes about the same time.
    """

    def __call__(self, total: int) -> AbstractContextManager[Advance]: ...


@dataclass(frozen=True)
class ExperimentType:
    """A type of experiment: how it is measured, drawn and judged."""

    name: str
    """The ``kind`` in files of experiments."""
    settings: type[Settings]
    """The settings in these files."""
    measure: Callable[[Any, Progress], Table]
    """Settings -> measurements."""
    draw: Callable[[Table, Any], "Figure"]
    """Measurements, settings -> a picture, begun with `experiments.canvas.blank`."""
    verdict: Callable[[Table, Any], list[str]]
    """Measurements, settings -> sentences, with numbers and their uncertainty."""


@dataclass(frozen=True)
class Experiment:
    """A type of experiment with the settings from a file."""

    name: str
    """The file's, without its ending."""
    type: ExperimentType
    settings: Settings
    reduced: bool
    """Whether the file's [reduced] settings are in place."""
