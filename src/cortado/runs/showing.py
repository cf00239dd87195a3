"""Pictures and films of a trajectory."""

from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import NDArray

from cortado.device.driver import device_named
from cortado.device.kernel_cache import start_warp
from cortado.discretise.domain import WITHOUT_PERIODS
from cortado.errors import InputError, shown
from cortado.pictures.film import Film
from cortado.pictures.notebook import as_text, with_view
from cortado.pictures.particle_view import Cloud, particle_view, thinned
from cortado.pictures.shaded_picture import ShadedPicture
from cortado.scene.scene import Scene, as_scene

if TYPE_CHECKING:
    from cortado.runs.trajectory import Trajectory

IN_A_NOTEBOOK = 1_000_000
"""Bytes of what a notebook shows in motion."""
MANY = 2000
"""Particles of which the nearest others are looked for."""


class Showing:
    """What shows a trajectory."""

    scene: Scene | None
    """What it is a run of; None of a file."""

    def picture(
        self, k: int = -1, *, scene: Scene | str | Path | None = None, device: str = "cpu", **settings: Any
    ) -> ShadedPicture:
        """A shaded picture of frame k, (rows, columns, 3), linear from 0 to 1, which a notebook shows. The camera is
        where it sees the fluid in every frame. Arguments and errors as of `film`."""
        from cortado.runs.drawing import page_of

        own = cast("Trajectory", self)
        if k not in range(-len(own), len(own)):
            raise InputError(f"k is {shown(k)}, but must be the number of one of {len(own)} frames, such as 0 or -1.")
        page = page_of(own, self._scene(scene), device_of(device), settings)
        return ShadedPicture.of(page.image(k % len(own)))

    def film(
        self, path: str | Path, *, scene: Scene | str | Path | None = None, device: str = "cpu", **settings: Any
    ) -> Film:
        """Write a film of the run, an mp4, and return it; a notebook plays it. One that is stopped (Ctrl-C) keeps its
        frames, and the same call goes on after them. See `docs/pictures.md`.

        Args:
            path: ends in .mp4, or in .webp, an animation that pages of text show, and which does not go on.
            scene: that of the run, or the path of its file; needed of a trajectory that was loaded from a file.
            device: of the rays, "cpu" or "cuda:0".
            settings: keys of the scene's table [picture], such as ``colour="speed"``, ``film_speed=0.25`` or
                ``film_frames=100``; ``lines=1080`` sets width and height; ``camera=pictures.Orbit()`` moves the camera.

        Raises:
            SceneError: settings that do not fit.
            InputError: a package is missing, or what ``colour`` names was not recorded and cannot be computed.
        """
        from cortado.runs.drawing import film_of

        return film_of(cast("Trajectory", self), self._scene(scene), path, device_of(device), settings)

    def _repr_html_(self) -> str:
        """In motion, with y up; and its first, middle and last frame, coloured by speed."""
        from cortado.pictures.plots import particles

        own = cast("Trajectory", self)
        if not len(own):
            return as_text(repr(own))
        dimension = own.positions.shape[2]
        domain = WITHOUT_PERIODS if own.scene is None else own.scene.container.domain(dimension)
        shown = [own[k] for k in sorted({0, len(own) // 2, len(own) - 1})]
        titles = [f"t = {frame.time:.4g} s" for frame in shown]
        speeds = [np.linalg.norm(frame.velocities, axis=1) for frame in shown]
        sets, label = [domain.wrapped(frame.positions) for frame in shown], "speed [m/s]"
        chosen, stride = thinned(len(own), own.particles, 2 * dimension + 1, IN_A_NOTEBOOK)
        thin = [array[chosen, ::stride] for array in (own.positions, own.velocities)]
        cloud = Cloud("run", domain.wrapped(thin[0]), np.linalg.norm(thin[1], axis=2))
        view = particle_view([cloud], own.times[chosen], _spacing(own.positions[0]), stride=stride)
        return with_view(own, view, lambda path: particles(sets, titles, path, colours=speeds, colour_label=label))

    def _scene(self, given: Scene | str | Path | None) -> Scene:
        found = self.scene if given is None else as_scene(given)
        if found is None:
            raise InputError("The trajectory does not know its scene, as it was loaded: give it, as scene=scene.")
        return found


def device_of(name: str) -> Any:
    """Warp's device of that name; raises `InputError` where there is none."""
    start_warp()
    return device_named(name)


def _spacing(positions: NDArray[Any]) -> float:
    """The usual distance [m] from a particle at one of positions (n, d) to the nearest other; 1 of a single one."""
    from scipy.spatial import KDTree

    if len(positions) < 2:
        return 1.0
    return float(np.median(KDTree(positions).query(positions[:MANY], k=2)[0][:, 1])) or 1.0
