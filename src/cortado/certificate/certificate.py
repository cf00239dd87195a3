"""Certificates, the results of tests whether gradients are right and for how many steps gradients are useful."""

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from html import escape
from io import StringIO
from math import log10
from os import PathLike
from typing import Any

import numpy as np

from cortado.arrays import as_one_number, require_whole
from cortado.calls import counted, public
from cortado.certificate.consistency import Consistency, LossHistory, check_consistency, first_rows, in_float64, up_to
from cortado.certificate.horizon import (
    PERTURBATION,
    Alignment,
    Horizon,
    alignment,
    checked_parameters,
    coherent_directions,
    directions,
    everything,
    growth,
    horizon,
    scales,
)
from cortado.errors import DivergedError, InputError, shown
from cortado.gradients import AdjointNorms
from cortado.gradients.estimator import NO_RUN
from cortado.losses import FinalPositions
from cortado.problem import Problem
from cortado.runs.run_folder import as_json, finite
from cortado.scene.parameter_values import Arrays, Values
from cortado.scene.parameters import Range, Role
from cortado.scene.scene import Scene
from cortado.simulation import Simulation

Random = np.random.Generator
BESIDE = 0.1 * PERTURBATION
"""Size of small random changes of the initial state, in the units of `PERTURBATION`."""
ROUGHLY = 0.1
"""Greatest accepted relative difference between the adjoint and the finite differences of a float32 loss."""


@dataclass(frozen=True)
class Certificate:
    """The result of `certify`: correctness and horizon of gradients, and the recommended estimator."""

    particles: int
    steps: int
    time_step: float
    """Time step of the run [s]."""
    loss: float
    loss_changes: dict[str, float]
    """Predicted change of the loss for a meaningful perturbation of each parameter."""
    consistency: Consistency
    """Comparison of derivatives by reverse mode, forward mode and finite differences, for all parameters."""
    wrong: tuple[str, ...]
    """Names of the parameters with a wrong derivative. The tuple is empty if all derivatives are right."""
    norms: np.ndarray
    """Norm of the exact adjoint of the state after each step (steps + 1,)."""
    growth: float
    """Growth of the adjoint's norm in each backward step [e-folds]."""
    horizons: tuple[Horizon, ...]
    """Horizon of each requested parameter. The tuple is empty if the adjoint is wrong."""
    alignment: Alignment | None
    """Comparison of each estimator's gradient with the smoothed gradient, or None without a smoothed gradient."""
    beside: Consistency | None = None
    """Comparison of derivatives near the initial state. None if the loss has no corner at the initial state."""
    beyond: tuple[str, ...] = ()
    """Sentences that say which steps could not be checked because a particle was lost."""

    def __repr__(self) -> str:
        verdict = f"right, horizon {self.horizon}" if self.right else f"WRONG for {', '.join(self.wrong)}"
        size = f"{counted(self.particles, 'particle')}, {counted(self.steps, 'step')}"
        return f"Certificate({size}, {verdict}, use gradients.{self.estimator})"

    def __str__(self) -> str:
        size = f"{counted(self.particles, 'particle')}, {counted(self.steps, 'step')}, float64"
        tried, changes, spread = {one.parameter for one in self.horizons if one.lasts}, [], ""
        for name, share in self.loss_changes.items():
            verdict = "WRONG" if name in self.wrong else "right" if share else "no effect on this loss"
            extrapolated = ", extrapolated" if share and name not in tried else ""
            changes.append((name, f"{share:.3e}{extrapolated}", verdict))
        lines = [size, _table(["parameter", "slope times a perturbation", "adjoint"], changes)]
        if not self.right:
            return "\n".join([*lines, f"The adjoint is WRONG: {consistency_words(self.consistency)}.", *self.beyond])
        ends = []
        for one in self.horizons:
            predicted = "later" if one.predicted is None else f"step {one.predicted}"
            ends.append((one.parameter, predicted, f"step {one.measured}" + (", the last" if one.lasts else "")))
        lines += [
            f"The adjoint is right: {consistency_words(self.consistency, self.beside)}.",
            f"The adjoint of a state grows by e^{self.growth:.4f} a step.",
            _table(["parameter", "predicted horizon", "measured horizon"], ends),
        ]
        if self.alignment is not None:
            rows = [(one.estimator, f"{one.cosine:.3f}", f"{one.size:.3g}") for one in self.alignment.estimators]
            error = f"to the gradient of the smoothed loss, whose own error is {self.alignment.noise:.0%}"
            lines += [_table(["estimator", "cosine", "size"], rows), error]
            if "(spread)" in self.estimator:
                rounded = {name: float(f"{value:.3g}") for name, value in self.alignment.spread.items()}
                spread = f" with spread = {rounded}"
        lines += [
            f"Up to step {self.horizon} of {self.steps}, {self.horizon * self.time_step:.4g} of "
            f"{self.steps * self.time_step:.4g} s, the exact gradient is useful. For {self.steps} steps use "
            f"gradients.{self.estimator}{spread}.",
            *self.beyond,
        ]
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        return f"<pre>{escape(str(self))}</pre>"

    @property
    def right(self) -> bool:
        """True if all derivatives are right."""
        return not self.wrong

    @property
    def horizon(self) -> int:
        """Last step up to which the exact gradient is useful for all requested parameters."""
        return min((one.measured for one in self.horizons), default=0)

    @property
    def estimator(self) -> str:
        """Python code of the gradient estimator that suits the requested parameters and number of steps."""
        if not self.right:
            return "RandomizedSmoothing()"
        if all(one.lasts for one in self.horizons):
            return "Exact()"
        if self.alignment is None:
            return "AdjointViscosity()"
        best = self.alignment.best
        return "RandomizedSmoothing()" if best is None else best.estimator

    def as_dict(self) -> dict[str, Any]:
        """Return the certificate as a dict that can be written as JSON."""
        c, found = self.consistency, asdict(self)
        found["consistency"] |= {"disagreement": c.disagreement, "miss": c.miss, "last_converged": c.last_converged}
        for one, made in zip(self.horizons, found["horizons"], strict=True):
            made |= {"measured": one.measured, "predicted": one.predicted}
        found |= {"right": self.right, "horizon": self.horizon, "estimator": self.estimator}
        return finite(as_json(found))


@public
def certify(
    problem: Problem | Simulation | Scene | str | PathLike[str],
    parameters: Values | Sequence[str] = ("gravity",),
    perturbation: float = PERTURBATION,
    seed: int = 0,
    steps: int | None = None,
) -> Certificate:
    """Check the gradients of a problem or a scene in float64.

    A float32 problem is rebuilt in float64 on the same device, because round-off would hide errors. A user-defined loss
    is still computed in float32. The adjoint of a user-defined loss may differ from its finite differences by 10 %.

    The adjoint is checked with respect to all parameters of the scene. The horizon and the recommended estimator are
    computed for ``parameters`` only. The horizon is the number of steps up to which the exact gradient is useful.

    Args:
        problem: a problem, a simulation, a scene, or the path of a scene file. Without a problem, ``steps`` is
            required, and the loss is the mean squared displacement of the particles.
        parameters: values by name, or names of parameters. A parameter without a value has its value in the scene.
        perturbation: size of a meaningful perturbation, relative to the parameter's value. Positions are perturbed
            relative to the spacing, and velocities relative to the speed of a fall over the fluid's height.
        seed: seed of the random directions.
        steps: number of steps. Leave out ``steps`` if ``problem`` is a `Problem`.

    If a particle is lost during the checks, the results cover only the earlier steps, and `Certificate.beyond` says so.
    Raises `InputError` for unsuitable arguments, and `DivergedError` if the problem itself diverges.

    Example::

        certificate = cortado.certify("examples/recover_gravity_small.toml", steps=20)
        assert certificate.right
    """
    require_whole("seed", seed, 0)
    if not 0.0 < as_one_number("perturbation", perturbation) < 1.0:
        raise InputError(f"perturbation is {shown(perturbation)}, but must be greater than 0 and less than 1.")
    if not isinstance(problem, Problem):
        if steps is None:
            found = type(problem).__name__
            raise InputError(f"steps is left out, but must be given, as a {found} has no number of steps.")
        simulation = problem if isinstance(problem, Simulation) else Simulation(problem, precision="float64")
        problem = Problem(simulation, steps, FinalPositions(simulation.positions))
    elif steps is not None:
        own = f"as the problem has {problem.steps} steps"
        raise InputError(f"steps is {shown(steps)}, but must be left out, {own}.")
    if problem.simulation.batch is not None:
        raise InputError("problem has a batch of scenes, but must have a single scene: certify one scene of the batch.")
    problem.simulation.scene.solver.fixed_time_step("a certificate, whose finite differences need fixed time steps")
    double = in_float64(problem)
    chosen = checked_parameters(double, parameters)
    try:
        return _certified(double, chosen, perturbation, seed)
    except DivergedError as error:
        if double is not problem:
            problem.value(chosen)  # raises the error of the problem itself, if it has one
        shorter = up_to(double, error.step - 1) if double is not problem else None
        if shorter is None:
            raise
        made = _certified(shorter, first_rows(double, chosen, shorter.steps), perturbation, seed)
        copied = f"certificates use float64, in which the run loses a particle in step {error.step}"
        return replace(made, beyond=(f"Nothing is checked beyond step {shorter.steps}: {copied}.", *made.beyond))


def _certified(problem: Problem, chosen: Arrays, perturbation: float, seed: int) -> Certificate:
    random = np.random.default_rng(seed)
    history, values = LossHistory(problem), everything(problem, chosen)
    norms = AdjointNorms(problem.simulation.solver, problem.steps)
    exact = problem.estimate({**chosen, **values}, observe=norms)
    along = directions(values, scales(problem, values, perturbation), random)
    consistency, wrong = _consistency(history, values, exact.gradient, along)
    beside, beyond = None, list[str]()
    if wrong and consistency.is_on_a_corner:
        beside, reached = _beside(problem, values, along, random)
        wrong = wrong if beside is not None and not beside.right else ()
        if reached < problem.steps:
            beyond.append(
                f"Beside the corner, nothing is checked beyond step {reached}: the changed run loses a particle."
            )

    sizes = scales(problem, chosen, perturbation)
    asked = {} if wrong else chosen
    of_asked = {name: exact.gradient[name] for name in asked}
    for name, value in asked.items():  # one over time may be given as one vector for all steps
        of_asked[name] = of_asked[name] if of_asked[name].shape == value.shape else of_asked[name].sum(axis=0)
    perturbations = coherent_directions(problem, chosen, sizes, random)
    known = {**problem.simulation.parameters(), **values}
    time = float(known["time_step"]) * max(problem.steps, 1)
    horizons = tuple(horizon(history, chosen, name, perturbations[name]) for name in asked)
    for one in horizons:
        moved = f"a run with a changed {one.parameter}"
        if one.reached == one.sample_steps[-1]:
            continue
        if one.reached == 0:
            beyond.append(f"{one.parameter} has no horizon: {moved} cannot begin, or loses a particle at once.")
        else:
            answer = f"nothing is known about {one.parameter}"
            beyond.append(f"Beyond step {one.reached} {answer}: {moved} loses a particle.")
    return Certificate(
        particles=problem.simulation.particles,
        steps=problem.steps,
        time_step=float(known["time_step"]),
        loss=exact.loss,
        loss_changes={name: abs(float((exact.gradient[name] * along[name]).sum())) for name in along},
        consistency=consistency,
        wrong=wrong,
        norms=np.hypot(norms.numpy()[:, 0], norms.numpy()[:, 1] / time),
        growth=growth(norms.numpy(), float(known["time_step"])) / max(problem.steps, 1),
        horizons=horizons,
        alignment=alignment(problem, asked, sizes, of_asked) if asked else None,
        beside=None if wrong else beside,
        beyond=tuple(beyond),
    )


def _consistency(
    history: LossHistory, values: Arrays, gradient: Arrays, along: Arrays
) -> tuple[Consistency, tuple[str, ...]]:
    """Return the check of all parameters together, and the names of the parameters with a wrong derivative."""
    together = check_consistency(history, values, gradient, along)
    if together.right:
        return together, tuple(along) if history.rough_miss(values, along) > ROUGHLY else ()
    alone = {name: check_consistency(history, values, gradient, {name: along[name]}) for name in along}
    return together, tuple(name for name in along if not alone[name].right) or tuple(along)


def _beside(problem: Problem, values: Arrays, along: Arrays, random: Random) -> tuple[Consistency | None, int]:
    """Check the derivatives at a randomly changed initial state. Also return the number of steps that were checked.

    The loss of fluid at rest may have a corner, as |v| has at v = 0, where the adjoint is a one-sided derivative.
    """
    known = problem.simulation.known
    states = {n: v for n, v in values.items() if known[n].role is Role.STATE and known[n].range is Range.ANY}
    shifts = directions(states, scales(problem, states, BESIDE), random)
    moved = {**values, **{name: values[name] + shift for name, shift in shifts.items()}}
    try:
        gradient = problem.estimate(moved).gradient
    except NO_RUN as error:
        shorter = up_to(problem, error.step - 1) if isinstance(error, DivergedError) else None
        if shorter is None:
            return None, 0
        moved, along = (first_rows(problem, one, shorter.steps) for one in (moved, along))
        problem, gradient = shorter, shorter.estimate(moved).gradient
    return check_consistency(LossHistory(problem), moved, gradient, along), problem.steps


WIDTH = 110


def consistency_words(c: Consistency, beside: Consistency | None = None) -> str:
    digits = f"reverse and forward mode agree to {_digits(c.disagreement)} digits"
    if c.miss is None:
        return f"{digits}, no difference is reliable here"
    slopes = f"on a corner of the loss: slopes of both sides differ by {100.0 * c.corner[c.converged][-1]:.2g} %"
    if beside is not None:
        return f"{digits}, {slopes}; beside it, {consistency_words(beside)}"
    found = f"{digits}, with differences to {_digits(c.miss)}, up to step {c.last_converged}"
    return f"{found} ({slopes})" if c.is_on_a_corner else found


def _digits(distance: float) -> str:
    return f"{min(max(-log10(distance), 0.0), 16.0):.0f}" if distance > 0.0 else "16"


def _table(columns: list[str], rows: Iterable[tuple[str, ...]]) -> str:
    from rich.console import Console
    from rich.table import Table

    table: Any = Table(*columns)
    for row in rows:
        table.add_row(*row)
    text = StringIO()
    Console(file=text, width=WIDTH, force_jupyter=False).print(table)  # a notebook would show it elsewhere
    return text.getvalue().rstrip()
