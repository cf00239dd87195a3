"""The balance of particles of a run: how many were in the fluid, came in, went out, and are in it now."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from cortado.calls import counted
from cortado.scene.drain_tables import count_name
from cortado.scene.emitter_table import waits
from cortado.scene.scene import Scene


@dataclass(frozen=True)
class Balance:
    """Numbers of particles, of which ``first`` + ``came`` = ``last`` + all that ``went``."""

    first: int
    """In the fluid at the start."""
    came: int
    """Out of emitters."""
    went: Mapping[str, int]
    """Into each drain, by name."""
    last: int
    """In the fluid at the end."""

    @classmethod
    def of(cls, scene: Scene, first: Mapping[str, Any], last: Mapping[str, Any]) -> Self:
        """Count the particles of two frames of a run of a scene, of which it takes `Frame.others`."""
        counts = {drain.name: count_name(drain.name) for drain in scene.drain}
        went = {name: int(np.ravel(last[key])[0] - np.ravel(first[key])[0]) for name, key in counts.items()}
        inside, left = (
            int(((np.ravel(at["drained"]) == 0.0) & ~waits(scene, at, np.size(at["drained"]))).sum())
            for at in (first, last)
        )
        return cls(inside, left - inside + sum(went.values()), went, left)

    def for_machines(self) -> dict[str, Any]:
        """Return the numbers by names."""
        return {"first": self.first, "in": self.came, "out": dict(self.went), "last": self.last}

    def rows(self) -> list[tuple[str, int, str]]:
        """Return rows (what, value, unit) of a table."""
        gone = [(f"particles that went into {name}", count, "") for name, count in self.went.items()]
        came = [("particles that came out of emitters", self.came, "")]
        return [("particles at the start", self.first, ""), *came, *gone, ("particles at the end", self.last, "")]

    def __str__(self) -> str:
        gone = " and ".join(f"{count} went into {name}" for name, count in self.went.items())
        return f"Of {counted(self.first, 'particle')} and {self.came} that came in {gone}, {self.last} are left"
