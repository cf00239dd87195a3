"""The film of a column of another program: its surface is drawn by Matplotlib, and blurred and noisy as by a camera."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter

from cortado.errors import InputError
from cortado.files.disk import sentences
from cortado.pictures.video_files import pyav

WIDTH, HEIGHT = 0.16, 0.08
"""Of what the camera sees [m]."""
OFF = (0.0013, -0.0007)
"""Where the camera's axis passes beside the middle of the box [m]."""
PIXELS, FRAME_RATE = 640, 60
BACKGROUND = np.array([0.92, 0.92, 0.90])
"""Of the lamp behind the syrup, in sRGB."""
LET_THROUGH = 0.45
"""Of its light, by the syrup."""
CELL = 0.00025
"""Of the grid on which the surface is looked for [m]."""
BLUR, NOISE, FLICKER = 1.5, 0.02, 0.004
"""In pixels, and in sRGB from 0 to 1: of each pixel alone, and of a whole frame."""


def film(column: Path, out: Path) -> str:
    """Draw the states that `benchmarks/peers/splishsplash_column.py` wrote, as a video."""
    av, (times, positions, _, spacing) = pyav(), column_of(column)
    every = round(1.0 / (FRAME_RATE * (times[1] - times[0])))
    with sentences(out.parent):
        out.parent.mkdir(parents=True, exist_ok=True)
    with sentences(out), av.open(str(out), "w") as container:
        stream = container.add_stream("libx264", rate=FRAME_RATE)
        stream.width, stream.height, stream.pix_fmt, stream.options = PIXELS, PIXELS // 2, "yuv444p", {"crf": "23"}
        for picture in camera(surface(x, spacing) for x in positions[::every]):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode())
    return f"The film is in {out}."


def column_of(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Times (frames,), positions and velocities (frames, n, 2), and the spacing, as the other program wrote them."""
    try:
        with np.load(path) as file:
            each = [file[name].astype(np.float64) for name in ("times", "positions", "velocities")]
            return *each, float(file["spacing"])
    except (OSError, ValueError, KeyError) as problem:
        raise InputError(f"{path} cannot be read as a column of splishsplash_column.py: {problem}.") from None


def surface(positions: np.ndarray, spacing: float) -> np.ndarray:
    """(rows, columns, 3) sRGB from 0 to 1: where the density of particles (n, 2), smoothed over a spacing and mirrored
    at the floor, is at least half of that of filled fluid, dyed fluid."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    edges = [np.arange(-0.01, end + 0.01, CELL) for end in (WIDTH, HEIGHT)]
    mirrored = np.concatenate([positions, positions * [1.0, -1.0]])
    counts = np.histogram2d(mirrored[:, 0], mirrored[:, 1], bins=edges)[0]
    filled = gaussian_filter(counts * (spacing / CELL) ** 2, 0.9 * spacing / CELL)
    x, y = (0.5 * (edge[1:] + edge[:-1]) for edge in edges)
    figure = Figure(figsize=(PIXELS / 100, PIXELS / 200), dpi=100, facecolor=tuple(BACKGROUND))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.axis("off")
    syrup = _to_srgb(LET_THROUGH * _to_light(BACKGROUND))
    axes.contourf(x, y, np.where(y < 0.0, 0.0, filled).T, levels=[0.5, 10.0], colors=[tuple(syrup)], antialiased=True)
    axes.set_xlim(OFF[0], OFF[0] + WIDTH)
    axes.set_ylim(OFF[1], OFF[1] + HEIGHT)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3] / 255.0


def camera(pictures: Iterator[np.ndarray]) -> Iterator[np.ndarray]:
    """(rows, columns, 3) of 8 bits: out of focus, with a lamp that flickers, and noise."""
    random, flicker = np.random.default_rng(3), 0.0
    for picture in pictures:
        flicker = 0.5 * flicker + FLICKER * random.standard_normal()
        noisy = gaussian_filter(picture, (BLUR, BLUR, 0)) * (1.0 + flicker)
        noisy += NOISE * random.standard_normal(picture.shape)
        yield np.rint(255.0 * np.clip(noisy, 0.0, 1.0)).astype(np.uint8)


def _to_light(srgb: np.ndarray) -> np.ndarray:
    """Of IEC 61966-2-1, above its linear part."""
    return ((srgb + 0.055) / 1.055) ** 2.4


def _to_srgb(light: np.ndarray) -> np.ndarray:
    return 1.055 * light ** (1.0 / 2.4) - 0.055
