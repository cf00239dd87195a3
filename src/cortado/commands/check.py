"""``cortado gradients check``: the certificate of a scene."""

import json
from collections.abc import Sequence
from io import StringIO
from math import log10
from pathlib import Path
from typing import Any

from cortado.certificate import Certificate, certify
from cortado.errors import ComputationError, InputError, shown
from cortado.losses import CentreOfMass, FinalPositions, Image, Loss
from cortado.problem import Problem
from cortado.scene import load_scene
from cortado.simulation import Simulation, check_steps
from cortado.terminal import tell

LOSSES = ("positions", "centre-of-mass", "image")


def check_scene(
    scene_file: Path,
    steps: int,
    parameters: Sequence[str],
    loss: str,
    change: float,
    out: Path | None,
    overrides: list[str],
    device: str,
    as_json: bool,
    seed: int,
) -> str:
    """The certificate as text; raises `ComputationError` when an adjoint is wrong."""
    if loss not in LOSSES:
        raise InputError(f"--loss is {shown(loss)}, but must be one of {', '.join(LOSSES)}.")
    simulation = Simulation(load_scene(scene_file, overrides), device, "float64")
    problem = Problem(simulation, check_steps(steps), _loss(loss, simulation))
    if out is not None:
        _make(out)
    certificate = certify(problem, parameters, change, seed)
    found = json.dumps(certificate.as_dict(), indent=2)
    text = found if as_json else "\n".join(_lines(certificate, loss))
    if out is not None:
        text += _written(certificate, found, out, as_json)
    if not certificate.right:
        tell(text)
        raise ComputationError(f"The adjoint is wrong for: {', '.join(certificate.wrong)}.")
    return text


def _loss(name: str, simulation: Simulation) -> Loss:
    """How far the fluid has come from where it starts."""
    if name == "positions":
        return FinalPositions(simulation.positions)
    if name == "centre-of-mass":
        return CentreOfMass(simulation.positions.mean(axis=0))
    renderer = simulation.renderer()
    return Image(renderer, renderer.render(simulation.state))


def _make(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as problem:
        raise InputError(f"The folder {folder} cannot be made: {problem}.") from problem


def _written(certificate: Certificate, found: str, out: Path, as_json: bool) -> str:
    from cortado.figures.gradient_check import gradient_check
    from cortado.files import write_atomically

    gradient_check(certificate, out / "certificate.png")
    write_atomically(out / "certificate.json", found.encode())
    return "" if as_json else f"\nThe results are in {out.resolve()}"


def _lines(certificate: Certificate, loss: str) -> list[str]:
    comparison, steps = certificate.comparison, certificate.steps
    lines = [
        f"{certificate.particles} particles, {steps} steps, float64, {loss}",
        _table(["parameter", "a change of it changes the loss by", "adjoint"], _parameters(certificate)),
    ]
    digits = f"reverse and forward mode agree to {_digits(comparison.disagreement)} digits"
    if comparison.miss is None:
        differences = "no difference is reliable here"
    else:
        differences = f"with differences to {_digits(comparison.miss)}, up to step {comparison.last_believed}"
    if not certificate.right:
        return [*lines, f"The adjoint is WRONG: {digits}, {differences}."]
    return [
        *lines,
        f"The adjoint is right: {digits}, {differences}.",
        f"The adjoint of a state grows by e^{certificate.growth:.4f} a step.",
        _table(["parameter", "predicted horizon", "measured horizon"], _horizons(certificate)),
        *_policies(certificate),
        f"Up to step {certificate.horizon} of {steps} the exact gradient means something. For {steps} steps use "
        f"policies.{certificate.policy}.",
    ]


def _parameters(certificate: Certificate) -> list[list[str]]:
    verdicts = {name: "WRONG" if name in certificate.wrong else "right" for name in certificate.shares}
    return [
        [name, f"{share:.3e}", verdicts[name] if share or name in certificate.wrong else "not felt by this loss"]
        for name, share in certificate.shares.items()
    ]


def _horizons(certificate: Certificate) -> list[list[str]]:
    return [
        [
            horizon.parameter,
            "later" if horizon.predicted is None else f"step {horizon.predicted}",
            f"step {horizon.measured}" + (", the last" if horizon.lasts else ""),
        ]
        for horizon in certificate.horizons
    ]


def _policies(certificate: Certificate) -> list[str]:
    agreement = certificate.agreement
    if agreement is None:
        return []
    rows = [[judged.policy, f"{judged.cosine:.3f}", f"{judged.size:.3g}"] for judged in agreement.policies]
    return [
        _table(["policy", "cosine", "size"], rows)
        + f"\nto the gradient of the smoothed loss, whose own error is {agreement.noise:.0%}"
    ]


def _digits(distance: float) -> str:
    return f"{min(max(-log10(distance), 0.0), 16.0):.0f}" if distance > 0.0 else "16"


def _table(columns: list[str], rows: list[list[str]]) -> str:
    from rich.console import Console
    from rich.table import Table

    table: Any = Table(*columns)
    for row in rows:
        table.add_row(*row)
    text = StringIO()
    Console(file=text, width=110).print(table)
    return text.getvalue().rstrip()
