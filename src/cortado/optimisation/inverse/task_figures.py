"""The pictures of a solved task, by what they tell."""

from dataclasses import dataclass, field

from cortado.pictures.report import Figures


@dataclass(frozen=True)
class TaskFigures:
    """Pictures and films, (caption, path) of each."""

    found: Figures = field(default_factory=list)
    """The run with what was found, in motion."""
    compared: Figures = field(default_factory=list)
    """Before, found and target."""
    parameters: Figures = field(default_factory=list)
    """What was found against what was hidden."""
    search: Figures = field(default_factory=list)
    """How the search went."""

    def __add__(self, other: "TaskFigures") -> "TaskFigures":
        """These, and then those of another."""
        return TaskFigures(**{name: figures + getattr(other, name) for name, figures in vars(self).items()})
