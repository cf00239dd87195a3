"""``cortado gradients check``: the certificate of a scene."""

import json
from collections.abc import Sequence
from pathlib import Path

from cortado.arrays import check_steps
from cortado.certificate import Certificate, certify
from cortado.errors import ComputationError, InputError, shown
from cortado.files.disk import make_folder
from cortado.files.terminal import tell
from cortado.losses import CentreOfMass, FinalPositions, Image, Loss
from cortado.problem import Problem
from cortado.scene.scene import load_scene
from cortado.simulation import Simulation

LOSSES = ("positions", "centre-of-mass", "image")


def check_scene(
    scene_file: Path,
    steps: int,
    parameters: Sequence[str],
    loss: str,
    perturbation: float,
    out: Path | None,
    overrides: list[str],
    device: str,
    as_json: bool,
    seed: int,
) -> str:
    """Compute the certificate of a scene's gradients as text; raise `ComputationError` when an adjoint is wrong."""
    if loss not in LOSSES:
        raise InputError(f"--loss is {shown(loss)}, but must be one of {', '.join(LOSSES)}.")
    scene = load_scene(scene_file, overrides).lasting(steps=check_steps(steps))
    simulation = Simulation(scene, device, "float64")
    problem = Problem(simulation, steps, _loss(loss, simulation))
    if out is not None:
        make_folder(out)
    certificate = certify(problem, parameters, perturbation, seed)
    found = json.dumps(certificate.as_dict(), indent=2)
    text = found if as_json else f"Loss: {loss}.\n{certificate}"
    if out is not None:
        text += _written(certificate, found, out, as_json)
    if not certificate.right:
        tell(text)
        raise ComputationError(f"The adjoint is wrong for: {', '.join(certificate.wrong)}.")
    return text


def _loss(name: str, simulation: Simulation) -> Loss:
    """Make the loss of a name: how far the fluid has come from where it starts."""
    if name == "positions":
        return FinalPositions(simulation.positions)
    if name == "centre-of-mass":
        return CentreOfMass(simulation.positions.mean(axis=0))
    renderer = simulation.renderer()
    return Image(renderer, renderer.render(simulation.initial))


def _written(certificate: Certificate, found: str, out: Path, as_json: bool) -> str:
    from cortado.files.disk import write_atomically
    from cortado.pictures.run_pictures import gradient_check

    gradient_check(certificate, out / "certificate.png")
    write_atomically(out / "certificate.json", found.encode())
    return "" if as_json else f"\nThe results are in {out.resolve()}"
