"""A task as a reader would be told of it."""

from cortado.optimisation.inverse.task import Task
from cortado.words import counted

_ALGORITHMS = {
    "adam": "Adam",
    "gradient_descent": "gradient descent",
    "lbfgs": "L-BFGS",
    "line_search": "a line search",
}


def task_in_words(task: Task) -> list[str]:
    """What is searched and what it shall reach, and how; a paragraph each."""
    problem, settings = task.problem, task.optimise
    seconds = problem.steps * task.scene.solver.time_step
    compared = "images" if problem.loss == "image" else "positions of all particles"
    frames = "at the end" if problem.frames == 1 else f"at {problem.frames} times, the end among them,"
    if problem.picture is not None:
        wanted = f"look like the picture “{problem.picture}” {frames}"
    else:
        wanted = f"come to the same {compared} {frames} as a run whose {_listed(task.true_parameters)} the search "
        wanted += "does not see"
    length = f"{counted(problem.steps, 'step')} ({seconds:.4g} s)" if problem.steps else "no steps"
    question = f"Which {_listed(task.start)} makes the fluid {wanted}? A run has {length}."
    knots = f", by {settings.knots} knots in time" if settings.knots else ""
    algorithm = _ALGORITHMS.get(settings.optimiser, settings.optimiser)
    how = (
        f"The search goes by {algorithm} with a learning rate of {settings.learning_rate:g}, "
        f"for {counted(settings.iterations, 'iteration')} at most{knots}."
    )
    return [question, f"{how}{_asked(task)}"]


def _listed(names: object) -> str:
    words = [name.replace("_", " ") for name in names]  # type: ignore[attr-defined]
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"


def _asked(task: Task) -> str:
    """What the check of the task asks for; empty where it asks for nothing."""
    check = task.optimise.check
    words = {
        "loss_reduction": f"a loss {check.loss_reduction:g} times smaller than at the start",
        "parameter_error": f"parameters within {100 * check.parameter_error:g}% of the hidden ones",
        "psnr": f"an image within {check.psnr:g} dB of the target",
    }
    asked = [sentence for name, sentence in words.items() if name in check.model_fields_set]
    return f" It is asked for {', '.join(asked[:-1])}{' and ' * (len(asked) > 1)}{asked[-1]}." if asked else ""
