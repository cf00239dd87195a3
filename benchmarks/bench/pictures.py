"""Pictures of a broken dam, timed, and compared with those that the CPU draws."""

import json
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from functools import partial
from statistics import median
from typing import Any

import numpy as np
import warp as wp

from benchmarks.bench.environment import environment
from benchmarks.bench.scene import dam_break
from cortado.device.launching import watched
from cortado.discretise.shapes import Points
from cortado.files.image_encoding import to_srgb
from cortado.pictures.painter import painter
from cortado.scene.appearance import Picture
from cortado.scene.scene import Scene

WATER = 0.1, 0.32, 0.62
SLOWEST = 8
"""Kernels that are named."""


def bench_pictures(particles: Sequence[int], lines: int, repeats: int, device: str, as_json: bool) -> str:
    """Seconds a picture with so many lines of each number of particles, as text."""
    found: dict[str, Any] = {"device": _name(device), "cores": environment()["cores"], "lines": lines, "sizes": []}
    for count in particles:
        found["sizes"].append(_measured(count, lines, repeats, device))
    return json.dumps(found, indent=2) if as_json else _as_text(found)


def _measured(count: int, lines: int, repeats: int, device: str) -> dict[str, Any]:
    scene = dam_break(count)
    scene = scene.model_copy(update={"picture": Picture(width=2 * round(lines * 8 / 9), height=lines)})
    positions = broken_dam(scene)
    state = positions, np.tile(WATER, (len(positions), 1))
    draw = partial(painter(scene, positions[None], device).image, *state)
    image = draw()
    row: dict[str, Any] = {"particles": len(positions), "s": median(_seconds(draw) for _ in range(repeats))}
    row["ms_of_kernels"], row["ms_of_the_rest"] = _by_kernel(draw, device)
    if not wp.get_device(device).is_cpu:
        row["psnr_to_the_cpu"] = psnr(image, painter(scene, positions[None], "cpu").image(*state))
    return row


def broken_dam(scene: Scene) -> Points:
    """(n, 3) [m] particles of a heap of water with waves that leans on one side of the box of `dam_break`, near a
    lattice, and of drops above it."""
    spacing, noise = scene.discretisation.spacing, np.random.default_rng(0)
    axes = [np.arange(0.5 * spacing, length, spacing) for length in (2.0, 1.5, 1.0)]
    x, y, z = (one.ravel() for one in np.meshgrid(*axes, indexing="ij"))
    top = 0.5 + 0.3 * np.cos(0.5 * np.pi * x) + 0.04 * np.sin(9.0 * x + 4.0 * z) * np.cos(7.0 * z)
    drops = noise.random(x.size) < 0.001 * (x > 1.5)
    places = np.stack([x, y, z], axis=1)[(y < top) | (drops & (y < 1.3))]
    return places + 0.1 * spacing * noise.standard_normal(places.shape)


def psnr(one: Points, other: Points) -> float:
    """Peak signal to noise ratio of two pictures, (rows, columns, 3) linear, as screens show them [dB]."""
    difference = to_srgb(one).astype(float) - to_srgb(other).astype(float)
    return float(10.0 * np.log10(255.0**2 / max((difference**2).mean(), 1e-12)))


def _by_kernel(draw: Callable[[], Points], device: str) -> tuple[dict[str, float], float]:
    """Milliseconds of the slowest kernels in one picture, each of them waited for, and of all that is no kernel."""
    times: dict[str, float] = defaultdict(float)

    def watcher(name: str, threads: Any, arguments: Any, work: Callable[[], None]) -> None:
        wp.synchronize_device(device)
        times[name.removeprefix("trace_kernel__locals__").removeprefix("illuminate_kernel__locals__")] += _seconds(
            work, device
        )

    with watched(watcher):
        whole = _seconds(draw)
    slowest = sorted(times, key=lambda name: -times[name])[:SLOWEST]
    return {name: 1e3 * times[name] for name in slowest}, 1e3 * (whole - sum(times.values()))


def _seconds(work: Callable[[], Any], device: str | None = None) -> float:
    start = time.perf_counter()
    work()
    if device is not None:
        wp.synchronize_device(device)
    return time.perf_counter() - start


def _name(device: str) -> str:
    return str(environment()["processor"]) if wp.get_device(device).is_cpu else str(wp.get_device(device).name)


def _as_text(found: dict[str, Any]) -> str:
    lines = [f"{found['device']}, {found['cores']} cores; pictures of {found['lines']} lines"]
    for row in found["sizes"]:
        kernels = ", ".join(f"{name} {ms:.3g}" for name, ms in row["ms_of_kernels"].items())
        lines += [f"{row['particles']:,} particles: {row['s']:.4g} s a picture"]
        lines += [f"  ms of kernels, one by one: {kernels}; of all else {row['ms_of_the_rest']:.3g}"]
        if "psnr_to_the_cpu" in row:
            lines += [f"  {row['psnr_to_the_cpu']:.1f} dB to what the CPU draws"]
    return "\n".join(lines)
