"""How high are the waves of a piston? Against linear theory: Dean and Dalrymple (1991), Water Wave Mechanics for
Engineers and Scientists, section 6.3."""

import numpy as np

from cortado import Simulation
from scenes import box, pool

GRAVITY = 9.81
SOONER = 1.3
"""By how much faster than their group the first waves that come back are taken to be."""


def piston(deep: int, depth_times_wavenumber: float, steepness: float, device: str = "cpu") -> dict[str, float]:
    """Waves on water 1 m and so many particles deep: their height over the stroke, and that over the one of linear
    theory, 2 (cosh 2kd - 1) / (sinh 2kd + 2kd), before any come back from the far end.

    ``steepness``: height of the waves over their length by that theory.
    """
    spacing, k = 1.0 / deep, depth_times_wavenumber
    omega = np.sqrt(GRAVITY * k * np.tanh(k))
    period, known = 2.0 * np.pi / omega, 2.0 * (np.cosh(2 * k) - 1.0) / (np.sinh(2 * k) + 2 * k)
    stroke = steepness * 2.0 * np.pi / k / known
    long, gauges = 12.0, (3.0, 3.5, 4.0)
    group = 0.5 * omega / k * (1.0 + 2 * k / np.sinh(2 * k))
    end = (2.0 * long - max(gauges)) / (SOONER * group)
    start = end - 2.0 * period
    step = 0.1 * spacing
    times = np.arange(0.0, end + 0.02, 0.01)
    places = 0.5 * stroke * np.minimum(times / period, 1.0) * np.sin(omega * times)
    middle, edge = np.array([-0.25, 0.75]), 5.0 * spacing
    path = {"times": times.tolist(), "positions": [[middle[0] + x, middle[1]] for x in places]}
    solid = box([-0.5, -edge], [0.0, 1.5 + edge], name="piston", motion="path", **path)
    tables = {"container": box([-1.0, 0.0], [long, 2.0]), "solver": {"kind": "projection", "time_step": step}}
    scene = pool([long, 1.0], [long, 2.0], spacing, solid=[solid], **tables)
    every = max(int(0.02 / step), 1)
    run = Simulation(scene, device).run(int(end / step), record_every=every)
    clock = np.arange(len(run.positions)) * every * step
    settled = clock >= start
    heights = [_height(run.positions[settled], clock[settled], gauge, spacing, omega) for gauge in gauges]
    found = float(np.mean(heights) / stroke)
    return {
        "particles": run.positions.shape[1],
        "periods before": float((start - max(gauges) / group) / period),
        "height over stroke": found,
        "over theory": found / known,
        "least and greatest": [round(float(h / stroke / known), 3) for h in (min(heights), max(heights))],
    }


def _height(positions: np.ndarray, times: np.ndarray, gauge: float, spacing: float, omega: float) -> float:
    """Of the waves of one frequency at a gauge [m], from the depth of the water, which is its area there over the width
    of a hat of four spacings to either side."""
    width = 4.0 * spacing
    weights = np.maximum(1.0 - np.abs(positions[:, :, 0] - gauge) / width, 0.0)
    depths = weights.sum(axis=1) * spacing**2 / width
    waves = [np.ones_like(times), times]
    waves += [f(n * omega * times) for n in (1, 2) for f in (np.cos, np.sin)]
    found = np.linalg.lstsq(np.stack(waves, axis=1), depths, rcond=None)[0]
    return float(2.0 * np.hypot(found[2], found[3]))
