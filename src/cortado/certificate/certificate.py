"""The certificate of a problem's gradients: are they right, how long do they mean something, and what to use beyond."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from os import PathLike
from typing import Any

import numpy as np

from cortado.certificate.agreement import Agreement, agreement
from cortado.certificate.changes import CHANGE, coherent_directions, directions, everything, point, scales
from cortado.certificate.course import Course
from cortado.certificate.horizon import Horizon, horizon
from cortado.certificate.rightness import Comparison, balanced, compare
from cortado.certificate.text import agreement_words, gradient_table, horizon_table, parameter_table
from cortado.certificate.twin import in_float64
from cortado.errors import InputError, shown
from cortado.gradients import AdjointNorms
from cortado.gradients.strength import growth
from cortado.io.notebook import as_text
from cortado.losses import FinalPositions
from cortado.parameters.values import Arrays, Values
from cortado.problem import Problem
from cortado.scene.scene import Scene
from cortado.simulation import Simulation
from cortado.words import counted

ROUGHLY = 0.1
"""How far the adjoint of a loss in float32 may be from differences of it, relative."""


@dataclass(frozen=True)
class Certificate:
    """What `certify` found."""

    particles: int
    steps: int
    loss: float
    shares: dict[str, float]
    """For every parameter how much a meaningful change of it changes the loss, by the adjoint."""
    comparison: Comparison
    """Of all parameters together."""
    wrong: tuple[str, ...]
    """Parameters with a wrong derivative; empty where the adjoint is right."""
    norms: np.ndarray
    """(steps + 1,) of the exact adjoint of every state."""
    growth: float
    """e-folds of the exact adjoint a step."""
    horizons: tuple[Horizon, ...]
    """For every parameter that was asked for; none where the adjoint is wrong."""
    agreement: Agreement | None
    """Of all of these together with the smoothed gradient."""

    def __repr__(self) -> str:
        verdict = f"right, horizon {self.horizon}" if self.right else f"WRONG for {', '.join(self.wrong)}"
        size = f"{counted(self.particles, 'particle')}, {counted(self.steps, 'step')}"
        return f"Certificate({size}, {verdict}, use gradients.{self.estimator})"

    def __str__(self) -> str:
        """As tables and sentences."""
        size = f"{counted(self.particles, 'particle')}, {counted(self.steps, 'step')}, float64"
        lines = [size, parameter_table(self.shares, self.wrong)]
        if not self.right:
            return "\n".join([*lines, f"The adjoint is WRONG: {agreement_words(self.comparison)}."])
        lines += [
            f"The adjoint is right: {agreement_words(self.comparison)}.",
            f"The adjoint of a state grows by e^{self.growth:.4f} a step.",
            horizon_table(self.horizons),
            *([] if self.agreement is None else [gradient_table(self.agreement)]),
            f"Up to step {self.horizon} of {self.steps} the exact gradient means something. For {self.steps} steps use "
            f"gradients.{self.estimator}.",
        ]
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        return as_text(self)

    @property
    def right(self) -> bool:
        """Whether every adjoint is right."""
        return not self.wrong

    @property
    def horizon(self) -> int:
        """The last step up to which the exact gradient means something, for all the parameters asked for."""
        return min((one.measured for one in self.horizons), default=0)

    @property
    def estimator(self) -> str:
        """Which to use for these parameters and that many steps, as it is written in Python."""
        if not self.right:
            return "RandomizedSmoothing()"
        if all(one.lasts for one in self.horizons):
            return "Exact()"
        if self.agreement is None:
            return "AdjointViscosity()"
        best = self.agreement.best
        return "RandomizedSmoothing()" if best is None else best.estimator

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        c, found = self.comparison, asdict(self)
        found["comparison"] |= {"disagreement": c.disagreement, "miss": c.miss, "last_believed": c.last_believed}
        for one, made in zip(self.horizons, found["horizons"], strict=True):
            made |= {"measured": one.measured, "predicted": one.predicted}
        found |= {"right": self.right, "horizon": self.horizon, "estimator": self.estimator}
        return _plain(found)


def certify(
    problem: Problem | Simulation | Scene | str | PathLike[str],
    parameters: Values | Sequence[str] = ("gravity",),
    change: float = CHANGE,
    seed: int = 0,
    steps: int | None = None,
) -> Certificate:
    """Check the gradients of a problem, always in float64; ``certify("scene.toml", steps=50)`` those of a scene.

    A problem in float32 is made once more in float64, on the same device, to be checked: the code is the same, and
    round-off does not hide what is wrong. A loss of your own goes on being asked in float32 then; its adjoint is held
    against its own differences to a tenth, which is what float32 allows.

    Whether the adjoint is right is asked of every parameter that the scene has. How long it means something, and which
    estimator to use beyond, of ``parameters``: values, or names of the scene's.

    Args:
        problem: one; or, with a number of ``steps``, a simulation, a scene or the path of its file: the loss is then
            how far the particles have come, their mean squared distance from where they start.
        change: what a meaningful change of a parameter is, in its own size; of positions in spacings, of velocities in
            those of a fall over the height of the fluid.
        seed: of the random directions.
        steps: left out where a problem is given, which has a number of its own.

    Raises `InputError` for arguments that do not fit, `DivergedError` where the problem itself diverges.
    """
    if not 0.0 < change < 1.0:
        raise InputError(f"change is {shown(change)}, but must be greater than 0 and less than 1.")
    problem = in_float64(_problem(problem, steps))
    chosen, random = point(problem, parameters), np.random.default_rng(seed)
    course, values = Course(problem), everything(problem, chosen)
    norms = AdjointNorms(problem.simulation.solver, problem.steps)
    exact = problem.estimate({**chosen, **values}, observe=norms)
    along = directions(values, scales(problem, values, change), random)
    comparison, wrong = _rightness(course, values, exact.gradient, along)

    sizes = scales(problem, chosen, change)
    asked = {} if wrong else chosen
    changes = coherent_directions(problem, chosen, sizes, random)
    time = float(values["time_step"]) * max(problem.steps, 1)
    return Certificate(
        particles=problem.simulation.particles,
        steps=problem.steps,
        loss=exact.loss,
        shares={name: abs(float((exact.gradient[name] * along[name]).sum())) for name in along},
        comparison=comparison,
        wrong=wrong,
        norms=np.hypot(norms.numpy()[:, 0], norms.numpy()[:, 1] / time),
        growth=growth(norms.numpy(), float(values["time_step"])) / max(problem.steps, 1),
        horizons=tuple(horizon(course, chosen, name, changes[name]) for name in asked),
        agreement=agreement(problem, asked, sizes, _of(chosen, exact.gradient)) if asked else None,
    )


def _problem(subject: Any, steps: int | None) -> Problem:
    """A problem as it is, or that of how far a scene comes in a number of steps."""
    if isinstance(subject, Problem):
        if steps is not None:
            own = f"as the problem has {subject.steps} steps"
            raise InputError(f"steps is {shown(steps)}, but must be left out, {own}.")
        return subject
    if steps is None:
        found = type(subject).__name__
        raise InputError(f"steps is left out, but must be given where what is certified is no Problem but a {found}.")
    simulation = subject if isinstance(subject, Simulation) else Simulation(subject, precision="float64")
    return Problem(simulation, steps, FinalPositions(simulation.positions))


def _of(chosen: Arrays, gradient: Arrays) -> Arrays:
    """The gradient in the shapes of the chosen parameters: tables may be one vector for all steps."""
    return {
        name: gradient[name] if gradient[name].shape == value.shape else gradient[name].sum(axis=0)
        for name, value in chosen.items()
    }


def _rightness(course: Course, values: Arrays, gradient: Arrays, along: Arrays) -> tuple[Comparison, tuple[str, ...]]:
    """The comparison of all parameters together, and, where it fails, those that fail alone."""
    together = compare(course, values, gradient, balanced(gradient, along))
    if together.right:
        return together, tuple(along) if course.rough_miss(values, along) > ROUGHLY else ()
    alone = {name: compare(course, values, gradient, {name: along[name]}) for name in along}
    return together, tuple(name for name in along if not alone[name].right) or tuple(along)


def _plain(found: Any) -> Any:
    """With arrays as lists, and None for what is not finite."""
    if isinstance(found, dict):
        return {name: _plain(value) for name, value in found.items()}
    if isinstance(found, (list, tuple, np.ndarray)):
        return [_plain(value) for value in found]
    if isinstance(found, (float, np.floating)):
        return float(found) if np.isfinite(found) else None
    return found.item() if isinstance(found, np.generic) else found
