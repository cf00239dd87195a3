"""``python -m experiments figure``: one experiment of the gradient study."""

from pathlib import Path

from experiments.experiment_files import load_experiment
from experiments.results import Results


def measure_figure(file: Path, out: Path | None, overrides: list[str], reduced: bool, redraw: bool) -> str:
    """Measure and draw, or draw again; returns the verdict and a line that says where everything is."""
    experiment = load_experiment(file, reduced, overrides)
    results = Results(Path("runs") / experiment.name if out is None else out)
    verdict = results.redraw(experiment) if redraw else results.measure(experiment)
    return "\n".join([*verdict, f"The results are in {results.folder}; open figure.png."])
