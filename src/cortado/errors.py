"""What Cortado raises: every error is one sentence for the user."""


class CortadoError(Exception):
    """Any error of ours."""


class InputError(CortadoError):
    """Wrong input by the user: one sentence that says what was found and what is wanted."""


class SceneError(InputError):
    """A mistake in a scene."""

    def __init__(self, file: str, field: str, found: str, wanted: str):
        super().__init__(f"{file}: {field} is {found}, but must be {wanted}.")
        self.file, self.field, self.found, self.wanted = file, field, found, wanted


class ComputationError(CortadoError):
    """The computation failed: it diverged, or did not converge."""


class DivergedError(ComputationError):
    """A particle was lost: its position is not finite, or absurdly far away."""

    def __init__(self, step: int, particle: int, advice: str):
        super().__init__(f"the run diverged at step {step}, particle {particle}: {advice}.")
        self.step, self.particle, self.advice = step, particle, advice


class CortadoWarning(UserWarning):
    """Something that a user should know and may choose to live with."""
