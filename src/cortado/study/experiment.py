"""What an experiment is: a kind, which measures, draws and judges, with the settings from a file."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Protocol

from cortado.io.progress import Advance
from cortado.scene import tables
from cortado.scene.fields import Text, components, quantity
from cortado.scene.scene import Scene
from cortado.study.tables import Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Settings(tables.Table):
    """What the file of an experiment holds beside its kind; each kind adds its own. The kinds of values of
    `cortado.scene.fields` make sentences of what is wrong."""

    title: Text
    """Above the picture."""

    def identity(self) -> dict[str, Any]:
        """What decides the measurement, for JSON: with the same, it need not be repeated."""
        return self.model_dump(mode="json")


class SceneSettings(Settings):
    """Settings of an experiment with a scene."""

    scene: Scene
    """In the file a path relative to it, or a table: its key ``file`` is such a path, everything else is put into that
    scene, as `cortado.study.scenes.varied` does; without ``file`` the table is a scene."""


class DeviceSettings(Settings):
    """Settings of an experiment that runs on a device; the others use the reference engine."""

    device: Text = "cpu"
    """"cpu", or "cuda:0" for the first GPU."""


Window = Annotated[tuple[Annotated[float, quantity("steps", ge=0.0)], ...], components("first", "last")]


class Progress(Protocol):
    """Shows how far a measurement is: ``with progress(total) as advance: ... advance(n)``, in units of your choice that
    take about the same time each."""

    def __call__(self, total: int) -> AbstractContextManager[Advance]: ...


@dataclass(frozen=True)
class Kind:
    """A kind of experiment."""

    name: str
    """What files call it."""
    settings: type[Settings]
    """What its files hold."""
    measure: Callable[[Any, Progress], Table]
    """Settings -> measurements."""
    draw: Callable[[Table, Any], "Figure"]
    """Measurements, settings -> a picture, begun with `cortado.study.canvas.blank`."""
    verdict: Callable[[Table, Any], list[str]]
    """Measurements, settings -> sentences, with numbers and their uncertainty."""


@dataclass(frozen=True)
class Experiment:
    """A kind with its settings."""

    name: str
    """The file's, without its ending."""
    kind: Kind
    settings: Settings
    reduced: bool
    """Whether the file's [reduced] settings are in place."""
