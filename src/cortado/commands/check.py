"""``cortado gradients check``: the certificate of a scene."""

import json
from io import StringIO
from pathlib import Path

from cortado.certificate import Certificate, certify
from cortado.errors import ComputationError
from cortado.losses import FinalPositions
from cortado.problem import Problem
from cortado.scene import load_scene
from cortado.simulation import Simulation, check_steps


def check_scene(scene_file: Path, steps: int, overrides: list[str], device: str, as_json: bool, seed: int) -> str:
    """The certificate as text; raises `ComputationError` when an adjoint is wrong."""
    simulation = Simulation(load_scene(scene_file, overrides), device, "float64")
    problem = Problem(simulation, check_steps(steps), FinalPositions(simulation.positions))
    certificate = certify(problem, seed)
    text = json.dumps(certificate.as_dict(), indent=2) if as_json else _table(certificate)
    if not certificate.right:
        print(text)
        wrong = ", ".join(c.parameter for c in certificate.comparisons if not c.right)
        raise ComputationError(f"The adjoint is wrong for: {wrong}.")
    return text


def _table(certificate: Certificate) -> str:
    from rich.console import Console
    from rich.table import Table

    title = f"{certificate.particles} particles, {certificate.steps} steps, float64, final positions"
    table = Table("parameter", "derivative", "reverse / forward", "reverse / difference", "verdict", title=title)
    for c in certificate.comparisons:
        verdict = "right" if c.right else "WRONG"
        if c.right and c.plateau is None:
            verdict = "right (no difference is reliable here)"
        table.add_row(c.parameter, f"{c.adjoint:.6e}", f"{c.disagreement:.1e}", f"{c.best_difference:.1e}", verdict)
    text = StringIO()
    Console(file=text, width=110).print(table)
    return text.getvalue().rstrip()
