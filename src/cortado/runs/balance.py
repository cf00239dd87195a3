"""The balance of particles of a run: how many were in the fluid, came in, went out, and are in it now."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from cortado.calls import counted
from cortado.scene.scene import Scene


@dataclass(frozen=True)
class Balance:
    """Numbers of particles, of which ``first`` + ``came`` = ``last`` + all that ``went``."""

    first: int
    """In the fluid at the start."""
    came: int
    """Out of the emitter."""
    went: Mapping[str, int]
    """Into each drain, by name."""
    last: int
    """In the fluid at the end."""

    @classmethod
    def of(cls, scene: Scene, first: Mapping[str, Any], last: Mapping[str, Any]) -> Self:
        """Count the particles of two frames of a run of a scene, of which it takes `Frame.others`."""
        names = [drain.name for drain in scene.drain]
        (first_waits, first_went), (last_waits, last_went) = (_counted(scene, others) for others in (first, last))
        went = dict(zip(names, (last_went - first_went).tolist(), strict=True))
        total = len(first["drained"])
        inside = (
            total - waits - int(gone.sum()) for waits, gone in ((first_waits, first_went), (last_waits, last_went))
        )
        return cls(next(inside), first_waits - last_waits, went, next(inside))

    def for_machines(self) -> dict[str, Any]:
        """Return the numbers by names."""
        return {"first": self.first, "in": self.came, "out": dict(self.went), "last": self.last}

    def rows(self) -> list[tuple[str, int, str]]:
        """Return rows (what, value, unit) of a table."""
        gone = [(f"particles that went into {name}", count, "") for name, count in self.went.items()]
        came = [("particles that came out of the emitter", self.came, "")]
        return [("particles at the start", self.first, ""), *came, *gone, ("particles at the end", self.last, "")]

    def __str__(self) -> str:
        gone = " and ".join(f"{count} went into {name}" for name, count in self.went.items())
        return f"Of {counted(self.first, 'particle')} and {self.came} that came in {gone}, {self.last} are left"


def _counted(scene: Scene, others: Mapping[str, Any]) -> tuple[int, NDArray[Any]]:
    """Return how many particles wait in the emitter, and how many each drain took."""
    drained, waits = np.asarray(others["drained"]), 0
    if scene.emitter is not None:
        upstream = scene.emitter.sample(scene.discretisation.spacing).upstream
        waits = int((upstream > float(np.ravel(others["emitted"])[0])).sum())
    return waits, np.array([int((drained == number).sum()) for number in range(1, len(scene.drain) + 1)])
