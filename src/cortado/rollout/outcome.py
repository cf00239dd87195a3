"""Warnings about a run: that its pressure did not converge, that an emitter runs dry, or that a batch lost scenes."""

from collections.abc import Iterator, Mapping

import numpy as np

from cortado.calls import counted
from cortado.rollout.rollout import Rollout
from cortado.scene.drain_tables import flow_name
from cortado.scene.emitter_table import emitted_name
from cortado.scene.scene import Scene
from cortado.sph.viscous_stress import Solve

TORN = 0.015
"""Divergence, times the step, above which a warning is given. Vortices, water at rest, and dams within the longest step
of a coarse grid reach 0.014. Tanks that sink while pressure builds up reach 0.02, longer steps with a coarse grid 0.02
to 0.06, and dams at their limit without a coarse grid 0.04."""
RARE = 0.05
"""Fraction of steps that may exceed `TORN` without a warning: the first has no earlier pressure, and splashes hit."""
SAME = 1e-6
"""Relative shortfall of an emitter's supply that still counts as enough."""


def trouble(rollout: Rollout, scene: Scene) -> Iterator[str]:
    """Yield warnings on the last forward run of a rollout: pressure, divergence, a dry emitter, lost scenes."""
    noted = rollout.diagnostics
    converged = noted["converged"]
    if not converged.all():
        yield not_converged_sentence(converged, scene)
    if torn := divergence_sentence(noted, scene):
        yield torn
    solves = noted.get(Solve.name, np.zeros(0))
    if missed := np.count_nonzero(solves >= Solve.most):
        found = f"the viscosity did not converge in {missed} of {solves.size} steps, in which it took {Solve.most}"
        yield f"{found} iterations: try a smaller time step."
    last, end = rollout.clocks[0].after(rollout.taken, 0.0), rollout.step_sizes.end
    if not rollout.lost and last.time < end < np.inf:
        found = f"the run ended at {last.time:.4g} s, before the time that was asked for, as steps became as short as"
        yield f"{found} {last.time_step:.2g} s: go on from its last state, or try a larger spacing."
    if scene.solver.chooses and (dry := dry_sentence(scene, rollout)):
        yield dry
    if rollout.lost:
        lost, batch = rollout.lost, rollout.solver.layout.members
        first = min(lost, key=lambda b: lost[b].step)
        yield f"{len(lost)} of {counted(batch, 'scene')} of the batch were lost. First scene {first}: {lost[first]}"


def not_converged_sentence(converged: np.ndarray, scene: Scene) -> str:
    """Return a warning that says how many steps ended with pressure above the tolerance, and what to try."""
    advice = "try a smaller time step, more iterations or a larger tolerance."
    spacing = scene.discretisation.spacing
    for index, emitter in enumerate(scene.emitter):
        if not scene.container.contains(emitter.particles(spacing), -0.25 * spacing).all():
            advice = (
                f"the column that waits in emitter[{index}] is not all inside the container, whose walls press on it. "
                f"Shorten emitter[{index}].length, or make the container larger."
            )
    return f"the pressure did not converge in {np.count_nonzero(~converged)} of {converged.size} steps: {advice}"


def divergence_sentence(diagnostics: Mapping[str, np.ndarray], scene: Scene) -> str | None:
    """Return a warning on the step in which the projection left most divergence; None where few steps left much."""
    found = diagnostics.get("divergence", np.zeros(0))
    if not (found > TORN).any():
        return None
    torn = np.nan_to_num(found, nan=0.0, posinf=0.0)  # what is not finite is of a scene that is lost
    if scene.solver.kind != "projection" or np.count_nonzero(torn > TORN) <= RARE * torn.size:
        return None
    step, *member = np.unravel_index(torn.argmax(), torn.shape)
    where = f"step {step + 1}" + "".join(f" of scene {b}" for b in member)
    return (
        f"the projection left a divergence of {torn.max():.2g} in {where}, times the step, and more than {TORN:g} in "
        f"{np.count_nonzero(torn > TORN)} of {torn.size} steps: try a smaller time step, more solver.iterations or a "
        "solver.tolerance."
    )


def dry_sentence(scene: Scene, rollout: Rollout) -> str | None:
    """Return a warning on the first emitter that runs out of fluid before the run ends, else None. With chosen steps,
    the end is known only after the run."""
    spacing, clock = scene.discretisation.spacing, rollout.clocks[0]
    taken = rollout.taken if scene.solver.chooses else rollout.steps
    times = clock.times(np.arange(taken + 1), float(rollout.time_steps.max()))
    for index, emitter in enumerate(scene.emitter):
        flow = np.max(rollout.parameters[flow_name(emitter.name)].numpy(), axis=0)[:taken]
        begun = float(np.max(rollout.initial[emitted_name(emitter.name)].numpy()))
        lengths = begun + np.cumsum(np.append(0.0, flow * np.diff(times))) / emitter.area(spacing)
        supply, end = emitter.supply(spacing) * spacing, times[-1]
        if emitter.fed_by or lengths[-1] * (1.0 - SAME) <= supply:
            continue
        advice = f"scene.lasting({end:.4g}) has more in reserve, as has a scene with emitter[{index}].volume"
        if emitter.volume is not None or scene.lasting(end) is scene:
            advice = f"a larger emitter[{index}].{'length' if emitter.volume is None else 'volume'} gives it more"
        dry = np.interp(supply, lengths, times)
        return f"{emitter.name} runs dry at {dry:.4g} s of a run to {end:.4g} s, as all of it is out: {advice}."
    return None
