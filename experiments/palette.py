"""Colours for an ordered family of curves: steps, horizons, precisions."""

Colour = tuple[float, float, float, float]


def palette(count: int) -> list[Colour]:
    """From dark to light, the lightest still readable on white."""
    from matplotlib import colormaps

    return [colormaps["viridis"](0.88 * k / max(count - 1, 1)) for k in range(count)]
