"""Pictures of a simulation's frames."""

from functools import partial
from pathlib import Path
from typing import Any, cast

from cortado.errors import InputError, shown
from cortado.particles.fields import Entry
from cortado.particles.state import State
from cortado.pictures.film import Film
from cortado.pictures.shaded_picture import ShadedPicture
from cortado.render.renderer import Renderer
from cortado.render.scene_renderer import Pictured, scene_renderer
from cortado.runs.drawing import alone, film_of, page_of
from cortado.runs.frame import Frame
from cortado.runs.measuring import Measuring
from cortado.runs.picture_settings import shown_as
from cortado.runs.trajectory import Trajectory
from cortado.scene.parameters.parameter import Axis
from cortado.scene.picture import Picture
from cortado.scene.quantities import NAMES
from cortado.scene.scene import Scene


class Picturing:
    """What takes pictures of a simulation."""

    scene: Scene
    device: Any
    """Of Warp."""
    particles: int
    """How many there are."""
    initial: State
    """The first state."""

    @property
    def dimension(self) -> int:
        """2 or 3."""
        return self.scene.dimension

    def renderer(self, **settings: Any) -> Renderer:
        """What takes pictures of the simulation, ``renderer.render(trajectory[k])``, and differentiates them: as the
        table ``[render]`` of its scene says, or from above, in 2-D as the plane is.

        ``settings`` replace keys of that table: ``resolution=(320, 240)``, or ``view="volume", position=(1, 1, 2),
        look_at=(0.2, 0.2, 0.2)``. `losses.Image` takes the renderer. Raises `SceneError` for settings that do not fit.
        """
        return scene_renderer(cast(Pictured, self), **settings)

    def picture(self, frame: Frame, **settings: Any) -> ShadedPicture:
        """A shaded picture of a frame, (rows, columns, 3), linear from 0 to 1, as the table ``[picture]`` of the scene
        says; ``settings`` replace keys of it: ``width=640, height=360``, as those of `film` do.

        Raises:
            SceneError: settings that do not fit.
            InputError: what ``colour`` names was not recorded in the frame, or is the age, which one frame does not
                tell.
        """
        if not isinstance(frame, Frame):
            raise InputError(f"frame is {shown(frame)}, but must be one frame of a trajectory, such as trajectory[-1].")
        scene, units = shown_as(self.scene, settings, self._units), self._units
        if (scene.picture or Picture()).colour == "age":
            raise InputError('One frame does not tell how old its fluid is: take trajectory.picture(k, colour="age").')
        return ShadedPicture.of(page_of(alone(frame), self.scene, self.device, settings, units).image(0))

    def film(self, trajectory: Trajectory, path: str | Path, **settings: Any) -> Film:
        """Write a film of a run of this simulation; as `Trajectory.film`, on the device of the simulation, which also
        computes what ``colour`` names where it was not recorded, such as the pressure."""
        if not isinstance(trajectory, Trajectory):
            raise InputError(f"trajectory is {shown(trajectory)}, but must be one, as simulation.run returns it.")
        measuring = partial(cast, Measuring, self)
        return film_of(trajectory, self.scene, path, self.device, settings, self._units, measuring)

    @property
    def _units(self) -> dict[str, str]:
        """Those of the fields of particles that a part of one's own keeps, by their names."""
        drawn = (Entry.NUMBER, Entry.VECTOR)
        known = (field for field in self.initial.fields if field.entry in drawn and field.axis is Axis.PARTICLE)
        return {field.name: field.unit for field in known if field.name not in NAMES}
