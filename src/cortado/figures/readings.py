"""What sensors have read, over time."""

from collections.abc import Mapping
from pathlib import Path

from cortado.figures.canvas import PALETTE, drawing
from cortado.sensors.log import Readings


def readings(found: Mapping[str, Readings], path: str | Path) -> Path:
    """A curve for each number of each sensor, those of one unit in one panel."""
    each = [(name, own, column, unit) for name, own in found.items() for column, unit in own.units.items()]
    lines = [(f"{name} {column}", unit, own, column) for name, own, column, unit in each]
    units = list(dict.fromkeys(unit for _, unit, _, _ in lines))
    with drawing(path, height=1.5 + 2.5 * len(units)) as figure:
        panels = figure.subplots(len(units), 1, sharex=True, squeeze=False)[:, 0]
        for panel, unit in zip(panels, units, strict=True):
            shown = [line for line in lines if line[1] == unit]
            for k, (label, _, own, column) in enumerate(shown):
                label = label.replace("_", " ")
                panel.plot(own.times, own[column], color=PALETTE[k % len(PALETTE)], linewidth=1.3, label=label)
            panel.set_ylabel(f"[{unit}]")
            panel.legend(loc="center left", bbox_to_anchor=(1.01, 0.5))
        panels[-1].set_xlabel("time [s]")
    return Path(path)
