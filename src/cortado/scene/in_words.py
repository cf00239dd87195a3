"""A scene as a reader would be told of it."""

from cortado.scene.containers import BoxContainer, CylinderContainer
from cortado.scene.scene import Scene
from cortado.words import counted


def scene_in_words(scene: Scene, particles: int) -> str:
    """What is in a scene that has so many particles, what holds it, and what acts on it; one sentence."""
    phases = " and ".join(
        f"{phase.name} ({phase.rest_density:g} kg/m³, {phase.viscosity:g} Pa s)" for phase in scene.phase
    )
    emitter = " of which an emitter gives some," if scene.emitter is not None else ""
    return (
        f"{counted(particles, 'particle')} of {phases} in {scene.dimension}-D,{emitter} "
        f"{scene.discretisation.spacing:g} m apart at rest, {_held(scene)}, "
        f"under gravity {vector(scene.forces.gravity)} m/s²{_scheduled(scene)}."
    )


def vector(components: tuple[float, ...]) -> str:
    """``(0, -9.81)``"""
    return f"({', '.join(f'{component:.6g}' for component in components)})"


def _scheduled(scene: Scene) -> str:
    courses = [
        f"{name.replace('_', ' ')} changes from {course.times[0]:g} s to {course.times[-1]:g} s"
        for name, course in scene.schedule.courses.items()
    ]
    return f"; its {' and '.join(courses)}" if courses else ""


def _held(scene: Scene) -> str:
    container = scene.container
    if isinstance(container, CylinderContainer):
        return f"in a cup of radius {container.radius:g} m and height {container.height:g} m"
    if isinstance(container, BoxContainer):
        lower, upper = container.extent()
        return f"in a box of {' × '.join(f'{length:g}' for length in upper - lower)} m"
    return "in free space"
