"""Pictures of a simulation's frames."""

from typing import Any, cast

import numpy as np

from cortado.errors import InputError, shown
from cortado.particles.fields import Entry, StateField
from cortado.particles.state import State
from cortado.pictures.painter import colours_of, painter
from cortado.pictures.scale import Scale
from cortado.render.renderer import Renderer
from cortado.render.scene_renderer import Pictured, scene_renderer
from cortado.runs.frame import Frame
from cortado.runs.solid_motion import posed, solid_motions
from cortado.scene.parameters.parameter import Axis
from cortado.scene.picture import Picture
from cortado.scene.quantities import NAMES, sizes
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

    def picture(self, frame: Frame, **settings: Any) -> np.ndarray:
        """A shaded picture of a frame, (rows, columns, 3), linear from 0 to 1, as the table ``[picture]`` of the scene
        says; ``settings`` replace keys of it: ``width=640, height=360``. ``colour_by`` may also name a field of the
        particles that a part of one's own keeps.

        Raises:
            SceneError: settings that do not fit.
            InputError: pysplashsurf is missing, for the surface of a liquid in 3-D; or the frame has not recorded what
                ``colour_by`` names.
        """
        if not isinstance(frame, Frame):
            raise InputError(f"frame is {shown(frame)}, but must be one frame of a trajectory, such as trajectory[-1].")
        given = {} if self.scene.picture is None else self.scene.picture.model_dump()
        wanted = {**given, **settings}
        own = self._own_field(wanted.get("colour_by"))
        judged = {**wanted, "colour_by": None} if own else wanted
        table = Picture(**judged).in_dimension(self.dimension, ("picture",))
        if own:
            table = table.model_copy(update={"colour_by": own.name})
        scene = self.scene.model_copy(update={"picture": table})
        motions = solid_motions(scene, {name: values[None] for name, values in frame.others.items()})
        draws = painter(posed(scene, motions, 0), frame.positions, self.device)
        if table.colour_by is None:
            return draws.image(frame.positions, colours_of(scene, frame.mass_fractions, self.particles))
        values, unit = sizes(table.colour_by, frame[table.colour_by], self.dimension), own.unit if own else None
        scale = Scale.of(table.colour_by, values, unit)
        return scale.beside(draws.image(frame.positions, scale.colours(values)))

    def _own_field(self, name: Any) -> StateField | None:
        """The field of the particles by that name that is no quantity of all scenes."""
        drawn = (Entry.NUMBER, Entry.VECTOR)
        known = (field for field in self.initial.fields if field.entry in drawn and field.axis is Axis.PARTICLE)
        return next((field for field in known if field.name == name and name not in NAMES), None)
