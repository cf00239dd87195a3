"""The picture of all environments, each at three times of an episode:

    python docs/site/environments.py

The script needs two minutes on one core. ``--only Raft`` draws one environment, as a test.
``--size large --device cuda:0`` draws finer fluids on a GPU.
"""

import argparse
import warnings
from collections.abc import Callable
from math import cos, pi, sin
from pathlib import Path

import numpy as np
from PIL import Image

from cortado.environments import FluidEnv
from cortado.environments.catalogue import TASKS, Latte, hidden_actions
from cortado.errors import CortadoWarning

PLACE = Path(__file__).parents[1] / "images" / "environments.jpg"
TIMES = 0.05, 0.35, 0.65
"""Parts of an episode at which pictures are taken."""


def carried(part: float) -> list[float]:
    """Accelerate, slow down, and tilt against both accelerations."""
    return [sin(2.0 * pi * min(part, 0.5)), 0.25 * cos(2.0 * pi * part) if part < 0.5 else 0.0]


def poured(part: float) -> list[float]:
    """Turn the jug until it lies on its side, and a little further."""
    return [0.3, -1.0 if part < 0.42 else 0.0]


ACTIONS: dict[str, Callable[[float], list[float]]] = {
    "Carry": carried,
    "Latte": lambda part: hidden_actions(Latte())[min(int(part * Latte.horizon), Latte.horizon - 1)].tolist(),
    "Pour": poured,
    "Raft": lambda part: [sin(4.0 * pi * part)],
    "Stir": lambda part: [cos(6.0 * pi * part), sin(6.0 * pi * part)],
    "Splash": lambda part: [sin(2.0 * pi * part), 0.2],
    "CarryInSpace": carried,
    "PourInSpace": poured,
}
"""Functions by task name. Each returns an action for the elapsed fraction of an episode."""


def row(name: str, size: str, device: str) -> np.ndarray:
    """Return pictures of an episode at its times, side by side."""
    env = FluidEnv(name, size, device, render_mode="rgb_array")
    env.reset(seed=1)
    horizon, found = TASKS[name].horizon, []
    for step in range(round(TIMES[-1] * horizon) + 1):
        if any(step == round(time * horizon) for time in TIMES):
            found.append(env.render())
        env.step(np.array(ACTIONS[name](step / horizon)))
    return np.concatenate(found, axis=1)


def main() -> None:
    parser = argparse.ArgumentParser(description="Draw the picture of all environments.")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--size", choices=("small", "large"), default="small")
    parser.add_argument("--only", action="append", choices=list(ACTIONS))
    parser.add_argument("--out", type=Path, default=PLACE)
    given = parser.parse_args()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CortadoWarning)
        rows = [row(name, given.size, given.device) for name in given.only or ACTIONS]
    pairs = [np.concatenate(rows[k : k + 2], axis=1) for k in range(0, len(rows) - len(rows) % 2, 2)]
    pairs += [np.pad(rows[-1], ((0, 0), (0, rows[-1].shape[1]), (0, 0)))] if len(rows) % 2 else []
    Image.fromarray(np.concatenate(pairs)).save(given.out, quality=90)


if __name__ == "__main__":
    main()
