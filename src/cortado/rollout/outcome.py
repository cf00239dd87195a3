"""Warnings about a run: unconverged pressure, divergent flow, an empty emitter, lost scenes."""

from collections.abc import Iterator, Mapping

import numpy as np

from cortado.calls import counted
from cortado.rollout.rollout import Rollout
from cortado.scene.drain_tables import flow_name
from cortado.scene.emitter_table import emitted_name
from cortado.scene.scene import Scene
from cortado.sph.viscous_solve import Solve

TORN = 0.015
"""Divergence of the velocity times the time step, above which a step counts towards a warning."""


def trouble(rollout: Rollout, scene: Scene) -> Iterator[str]:
    if rollout.is_calm({"divergence": TORN, Solve.name: Solve.most - 1}) and not scene.solver.chooses:
        return
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
    """Return a warning with the number of steps in which the pressure did not converge, and advice."""
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
    """Return a warning about the step with the greatest divergence of the velocity, or None if few steps
    exceed `TORN`."""
    found = diagnostics.get("divergence", np.zeros(0))
    if not (found > TORN).any():
        return None
    torn = np.nan_to_num(found, nan=0.0, posinf=0.0)  # lost scenes are not finite
    if scene.solver.kind != "projection" or np.count_nonzero(torn > TORN) <= 0.05 * torn.size:
        return None
    step, *member = np.unravel_index(torn.argmax(), torn.shape)
    where = f"step {step + 1}" + "".join(f" of scene {b}" for b in member)
    return (
        f"the projection left a divergence of {torn.max():.2g} in {where}, times the step, and more than {TORN:g} in "
        f"{np.count_nonzero(torn > TORN)} of {torn.size} steps: try a smaller time step, more solver.iterations or a "
        "solver.tolerance."
    )


def dry_sentence(scene: Scene, rollout: Rollout) -> str | None:
    """Return a warning about the first emitter that runs out of fluid before the end of the run, or None."""
    spacing, clock = scene.discretisation.spacing, rollout.clocks[0]
    taken = rollout.taken if scene.solver.chooses else rollout.steps
    times = clock.times(np.arange(taken + 1), float(rollout.time_steps.max()))
    for index, emitter in enumerate(scene.emitter):
        flow = np.max(rollout.parameters[flow_name(emitter.name)].numpy(), axis=0)[:taken]
        begun = float(np.max(rollout.initial[emitted_name(emitter.name)].numpy()))
        lengths = begun + np.cumsum(np.append(0.0, flow * np.diff(times))) / emitter.area(spacing)
        supply, end = emitter.supply(spacing) * spacing, times[-1]
        if emitter.fed_by or lengths[-1] * (1.0 - 1e-6) <= supply:
            continue
        advice = f"scene.lasting({end:.4g}) has more in reserve, as has a scene with emitter[{index}].volume"
        if emitter.volume is not None or scene.lasting(end) is scene:
            advice = f"a larger emitter[{index}].{'length' if emitter.volume is None else 'volume'} gives it more"
        dry = np.interp(supply, lengths, times)
        return f"{emitter.name} runs dry at {dry:.4g} s of a run to {end:.4g} s, as all of it is out: {advice}."
    return None
