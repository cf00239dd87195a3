"""What fits say of videos that another model made."""

import numpy as np

import cortado
from cortado import measured

from .cases import TIME_STEP, correlated, two_fluids, video


def of_another_model() -> str:
    """A video that the other solver made, and one of a finer spacing, fitted with PCISPH at the spacing 0.02 m."""
    case, text = video(), list[str]()
    makers = {
        "projection": two_fluids(2.0, kind="projection", time_step=TIME_STEP, iterations=16),
        "finer spacing": two_fluids(2.0, 0.0125, time_step=TIME_STEP, minimum_iterations=4, maximum_iterations=4),
    }
    one = case.experiment.observations["camera"]
    for name, made in makers.items():
        lens = made.renderer(resolution=(24, 18))
        seen = measured.Experiment(made, {"camera": measured.Video(lens, one.times, np.zeros((8, 18, 24, 3)))})
        clean = seen.predicted({"viscosity": np.array([2.0, 2.0])})["camera"]
        noise = case.sizes["camera"] * correlated(np.random.default_rng(0), 8, (18, 24, 3), case.kept)
        fitted = cortado.fit(case.experiment.measured_again({"camera": clean + noise}), case.start, case.bounds)
        text += [f"{name}:", *(f"  {line}" for line in str(fitted).splitlines())]
    return "\n".join(text)
