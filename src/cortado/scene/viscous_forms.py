"""What is said of the pairwise viscous force, whose fluid is not as viscous as asked for."""

from cortado.scene.model import SceneTables

FAULT = "with which fluid is 0.6 to 1.4 times as viscous as asked for, by the direction of the shear"
"""As measured in waves of shear (`docs/discretisation.md`)."""


def wall_sentence(scene: SceneTables) -> str | None:
    """What to say of a scene whose walls hold the fluid back; None if there is nothing."""
    return _sentence(scene, 'slip is "no" at walls') if scene.sticks else None


def parameter_sentence(scene: SceneTables) -> str | None:
    """What to say where the viscosity is a parameter of a problem; None if there is nothing."""
    return _sentence(scene, "the viscosity is a parameter")


def _sentence(scene: SceneTables, where: str) -> str | None:
    if scene.forces.viscosity != "pairwise":
        return None
    return f'{where} and forces.viscosity is "pairwise", {FAULT}: viscosity = "stress" has it within 1 %.'
