"""What rays meet: the surface of a fluid and its shadow, of one state, or of many in several processes."""

import os
import signal
from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from itertools import islice
from multiprocessing import get_context
from typing import NamedTuple

import numpy as np

from cortado.device.cores import usable_cores
from cortado.discretise.shapes import Points
from cortado.errors import ComputationError
from cortado.pictures.shadow import floor_shadow
from cortado.pictures.stage import Stage
from cortado.pictures.surface import Surface, liquid, spheres
from cortado.scene.camera_paths import View
from cortado.scene.scene import Scene

LARGE = 20_000
"""Particles from which on a surface takes longer than to hand it from one process to another."""
FEWEST, MOST = 4, 16
"""Processes: with fewer cores one does all, on all of them."""


class State(NamedTuple):
    """What a picture shows."""

    positions: Points
    """(n, d) of particles [m], in the scene's axes"""
    colours: Points
    """(n, 3) of particles, linear from 0 to 1"""
    pose: Scene | None = None
    """The scene with its solids where they are; where it has them if left out."""
    view: View | None = None
    """Where the camera is; home if left out."""


@dataclass(frozen=True)
class Scenery:
    """The fluid of one state, in the frame of the picture."""

    stage: Stage
    """With solids and the camera where they are."""
    surface: Surface
    shadow: tuple[Points, Points, float]
    """As `floor_shadow` returns it."""


def scenery(home: Stage, state: State) -> Scenery:
    """That of a state in 3-D."""
    stage, colours = home.at(state.pose, state.view), np.asarray(state.colours, dtype=np.float64)
    placed = stage.placed(np.asarray(state.positions, dtype=np.float64))
    if stage.picture.surface == "liquid":
        wet, of = stage.wetting(placed)
        surface = liquid(wet, colours[of], stage.spacing)
    else:
        surface = spheres(placed, colours, stage.spacing)
    return Scenery(stage, surface, floor_shadow(stage, placed, colours))


def sceneries(stage: Stage, states: Iterable[State], processes: int) -> Iterator[Scenery]:
    """The scenery of each state in their order. Several processes work on the states that come next; they are started
    anew, so that a script that draws films needs ``if __name__ == "__main__"``.

    Raises:
        ComputationError: one of the processes was stopped.
    """
    if processes == 1:
        yield from (scenery(stage, state) for state in states)
        return
    left = iter(states)
    pool = ProcessPoolExecutor(processes, mp_context=get_context("spawn"), initializer=_worker)
    try:
        begun: deque[Future[Scenery]] = deque(
            pool.submit(scenery, stage, state) for state in islice(left, 2 * processes)
        )
        while begun:
            found = begun.popleft().result()
            begun.extend(pool.submit(scenery, stage, state) for state in islice(left, 1))
            yield found
    except BrokenProcessPool as problem:
        raise ComputationError(
            "A process that computes surfaces for pictures was stopped, by the system perhaps for want of memory: "
            "set the environment variable CORTADO_CORES to 1, and one process does all."
        ) from problem
    finally:
        pool.shutdown(cancel_futures=True)


def processes_for(particles: int) -> int:
    """How many processes compute the sceneries of so many particles."""
    cores = min(usable_cores(), MOST)
    return cores if particles >= LARGE and cores >= FEWEST else 1


def _worker() -> None:
    """Each on a core of its own; the first process alone hears Ctrl-C and stops the others."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.environ["RAYON_NUM_THREADS"] = os.environ["CORTADO_CORES"] = "1"
