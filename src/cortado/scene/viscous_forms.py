"""What is said of the forms of the viscous force whose fluid is not as viscous as asked for."""

from cortado.scene.model import SceneTables

FAULTS = {
    "pairwise": "with which fluid is 0.6 to 1.4 times as viscous as asked for, by the direction of the shear",
    "laminar": "with which fluid is 0.8 to 1 times as viscous as asked for, and is braked where it turns as a whole",
}
"""By the form, as measured in waves of shear (`docs/discretisation.md`)."""


def wall_sentence(scene: SceneTables) -> str | None:
    """What to say of a scene whose walls hold the fluid back; None if there is nothing."""
    return _sentence(scene, 'slip is "no" at walls') if scene.sticks else None


def parameter_sentence(scene: SceneTables) -> str | None:
    """What to say where the viscosity is a parameter of a problem; None if there is nothing."""
    return _sentence(scene, "the viscosity is a parameter")


def _sentence(scene: SceneTables, where: str) -> str | None:
    form = scene.forces.viscosity
    if form not in FAULTS:
        return None
    return f'{where} and forces.viscosity is "{form}", {FAULTS[form]}: viscosity = "stress" has it within 1 %.'
