"""Pictures of a simulation's frames."""

from typing import Any, cast

import numpy as np

from cortado.errors import InputError, shown
from cortado.pictures.painter import colours_of, painter
from cortado.pictures.scale import Scale
from cortado.render.renderer import Renderer
from cortado.render.scene_renderer import Pictured, scene_renderer
from cortado.runs.trajectory import Frame
from cortado.scene.picture import Picture
from cortado.scene.quantities import sizes
from cortado.scene.scene import Scene


class Picturing:
    """What takes pictures of a simulation."""

    scene: Scene
    device: Any
    """Of Warp."""
    particles: int
    """How many there are."""

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

    def picture(self, frame: Frame, **settings: Any) -> np.ndarray:
        """A shaded picture of a frame, (rows, columns, 3), linear from 0 to 1, as the table ``[picture]`` of the scene
        says; ``settings`` replace keys of it: ``width=640, height=360``.

        Raises:
            SceneError: settings that do not fit.
            InputError: pysplashsurf is missing, for the surface of a liquid in 3-D; or the frame has not recorded what
                ``colour_by`` names.
        """
        if not isinstance(frame, Frame):
            raise InputError(f"frame is {shown(frame)}, but must be one frame of a trajectory, such as trajectory[-1].")
        given = {} if self.scene.picture is None else self.scene.picture.model_dump()
        table = Picture(**{**given, **settings}).in_dimension(self.dimension, ("picture",))
        scene = self.scene.model_copy(update={"picture": table})
        draws = painter(scene, frame.positions, self.device)
        if table.colour_by is None:
            return draws.image(frame.positions, colours_of(scene, frame.mass_fractions, self.particles))
        values = sizes(table.colour_by, frame[table.colour_by], self.dimension)
        scale = Scale.of(table.colour_by, values)
        return scale.beside(draws.image(frame.positions, scale.colours(values)))
