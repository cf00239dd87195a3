"""Which particles of a run wait in its emitter, and how long the others are out."""

import numpy as np
from numpy.typing import NDArray

from cortado.runs.trajectory import Trajectory
from cortado.scene.scene import Scene


def is_out(scene: Scene, emitted: NDArray | None, particles: int) -> NDArray[np.bool_]:
    """(n,) whether each of the particles of a scene has left the emitter, of which so much came out: `Frame.others`
    has ``emitted`` (1,) [m]; all have where there is none. Where there is no other fluid, the layer that comes first is
    out from the start."""
    found = np.ones(particles, dtype=bool)
    if scene.emitter is not None and emitted is not None:
        upstream = scene.emitter.sample(scene.discretisation.spacing).upstream
        least = upstream.min() if len(upstream) == particles else 0.0
        found[particles - len(upstream) :] = upstream <= max(float(np.ravel(emitted)[0]), least)
    return found


def shown_places(scene: Scene, trajectory: Trajectory) -> NDArray:
    """(frames, n, d) [m] where particles are that are shown; those that wait in an emitter count at its opening."""
    out = np.array([is_out(scene, frame.others.get("emitted"), trajectory.particles) for frame in trajectory])
    return (
        trajectory.positions
        if out.all()
        else np.where(out[..., None], trajectory.positions, trajectory.others["outlet"])
    )


def those(out: NDArray[np.bool_]) -> NDArray[np.bool_] | slice:
    """What takes from arrays (n, ...) the particles that are out (n,): all of them without a copy, where all are."""
    return slice(None) if out.all() else out


def ages(scene: Scene, trajectory: Trajectory) -> NDArray:
    """(frames, n) [s] how long particles are out of the emitter, between frames as if its speed were even; of others
    the time since the run began, and 0 of what still waits."""
    since = np.tile(trajectory.times[0], trajectory.particles).astype(np.float64)
    if scene.emitter is not None and "emitted" in trajectory.others:
        upstream = scene.emitter.sample(scene.discretisation.spacing).upstream
        came = np.asarray(trajectory.others["emitted"], dtype=np.float64).reshape(len(trajectory), -1)[:, 0]
        since[len(since) - len(upstream) :] = np.interp(upstream, came, trajectory.times, right=np.inf)
    return np.maximum(trajectory.times[:, None] - since, 0.0)
