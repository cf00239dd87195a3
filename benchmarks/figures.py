"""Redraw and rewrite what `docs/performance.md` shows: ``python benchmarks/figures.py benchmarks/results/*.json``.

Of each kind of device, CPU and GPU, the last file given is shown, and of each size the run in it that other
processes disturbed least: tables between the comments that mark their place in the document, and a log-log figure.
"""

import json
import re
import sys
from pathlib import Path
from textwrap import fill
from typing import Any

from matplotlib.ticker import NullFormatter
from speed import busiest

from cortado.pictures.plots import DASHED, PALETTE, drawing

DOCS = Path(__file__).parents[1] / "docs"
PAGE = DOCS / "performance.md"
MISSING = "*No results file of this kind is there yet.*"
Run = dict[str, Any]


QUIET = 0.1
"""Cores that other processes may keep busy without disturbing."""


def shown(runs: list[Run]) -> Run:
    """The last run with all sizes of its file, each from the run whose programs were disturbed least; of several that
    were disturbed by no more than `QUIET` from the last."""
    sizes: dict[int, Run] = {}
    for size in (size for run in runs for size in run["sizes"]):
        known = sizes.get(size["particles"])
        if known is None or busiest(size["measured"]) <= max(busiest(known["measured"]), QUIET):
            sizes[size["particles"]] = size
    return {**runs[-1], "sizes": [sizes[particles] for particles in sorted(sizes)]}


def kind(run: Run) -> str:
    """ "cpu" or "gpu"."""
    return "cpu" if run["settings"]["device"] == "cpu" else "gpu"


def own_rows(run: Run) -> list[Run]:
    """Cortado's measurements, by size."""
    return [size["measured"]["Cortado"] for size in run["sizes"] if "Cortado" in size["measured"]]


def draw(run: Run, file: Path) -> None:
    """Milliseconds a step over particles, forward and with the gradient, with the floors of Cortado's."""
    with drawing(file, 9.0, 4.6) as figure:
        panels = figure.subplots(1, 2, sharey=True)
        names = list(dict.fromkeys(name for size in run["sizes"] for name in size["measured"]))
        for panel, what, title in zip(panels, ("rollout", "gradient"), ("forward", "with the gradient"), strict=True):
            for colour, name in zip(PALETTE, names, strict=False):
                rows = [size["measured"][name] for size in run["sizes"] if what in size["measured"].get(name, {})]
                if rows:
                    points = [row["particles"] for row in rows], [row[what]["ms"] for row in rows]
                    panel.loglog(*points, "o-", color=colour, label=name)
            rows = own_rows(run)
            floors = [row["particles"] for row in rows], [row[what]["floor_ms"] for row in rows]
            panel.loglog(*floors, color=PALETTE[0], label="Cortado's floor", **DASHED)
            panel.set(xlabel="particles", title=title)
            panel.xaxis.set_minor_formatter(NullFormatter())
        panels[0].set_ylabel("ms a step")
        panels[0].legend()


def tables(run: Run) -> str:
    """What the document says of a run."""
    around, settings, rows = run["environment"], run["settings"], own_rows(run)
    names = [name for name in run["sizes"][0]["measured"] if name != "Cortado"]
    lines = [
        f"{around['device']}, {around['cores']} cores; {around['date'][:10]}, Cortado {around['cortado']}, "
        f"Warp {around['warp']}, {settings['precision']}, medians of {span(rows, 'repeats')} times "
        f"{span(rows, 'steps')} steps; of several rounds and runs the one that other processes disturbed least. Copy "
        f"bandwidth {span(rows, 'copy_bandwidth_gb_per_s')} GB/s; an empty launch takes "
        f"{span(rows, 'empty_launch_us')} us.",
        "",
        "Milliseconds a step, forward / with the gradient. *Others*: cores that other processes kept busy while each",
        "of the programs ran, in the order of the columns.",
        "",
        "| particles | Cortado | its floor | step alone | " + " | ".join([*names, "others"]) + " |",
        "|---|---|---|---|" + "---|" * (len(names) + 1),
    ]
    for size in run["sizes"]:
        own = size["measured"].get("Cortado")
        if own:
            floors = f"{own['rollout']['floor_ms']:.3g} / {own['gradient']['floor_ms']:.3g}"
            cells = [f"{own['particles']:,}", both(own), floors, f"{own['step']['ms']:.3g}"]
            cells += [both(size["measured"].get(name), own) for name in names]
            busy = [row["cores_busy_elsewhere"] for row in size["measured"].values()]
            cells.append("not known" if None in busy else ", ".join(f"{cores:.1f}" for cores in busy))
            lines.append(f"| {' | '.join(cells)} |")
    for size in run["sizes"]:
        lines += [f"\n{name}, {size['particles']:,} particles: {why}." for name, why in size["failed"].items()]
    lines += ["", *(f"Not installed: {name}." for name in run["not_installed"])]
    return "\n".join([*lines, passes(rows), "", memory(rows)])


def span(rows: list[Run], name: str) -> str:
    """A number of all rows, or the least and the greatest."""
    least, most = (f"{pick(row[name] for row in rows):.2g}" for pick in (min, max))
    return least if least == most else f"{least} to {most}"


def both(row: Run | None, own: Run | None = None) -> str:
    """Forward and gradient of one program, and how many times as long each takes as Cortado's own."""
    words = []
    for what in ("rollout", "gradient"):
        if row and what in row:
            ratio = f" ({row[what]['ms'] / own[what]['ms']:.2g} x)" if own else ""
            words.append(f"{row[what]['ms']:.3g}{ratio}")
    return " / ".join(words) or "-"


def short(value: float) -> str:
    """Two digits at least, and no powers of ten."""
    return f"{value:,.0f}" if value >= 100.0 else f"{value:.2g}"


def passes(rows: list[Run]) -> str:
    """The passes of a step and of the way back: microseconds of all launches in a step, and times the floor."""
    lines = ["Passes of a step, in microseconds, and how many times the floor that is:", ""]
    lines += ["| | launches | " + " | ".join(f"{row['particles']:,}" for row in rows) + " |"]
    lines += ["|---|---|" + "---|" * len(rows)]
    for which in ("passes", "adjoint_passes"):
        for first in rows[-1][which]:
            cells = [first["name"], str(first["launches"])]
            for row in rows:
                found = next((one for one in row[which] if one["name"] == first["name"]), None)
                cells.append(
                    f"{short(1e3 * found['ms'])} ({short(found['ms'] / found['floor_ms'])} x)" if found else "-"
                )
            lines.append(f"| {' | '.join(cells)} |")
    pairs = {one["name"]: one["pairs_per_second"] for one in rows[-1]["passes"] if "pairs_per_second" in one}
    said = ", ".join(f"{name} {1e-6 * rate:.3g}" for name, rate in pairs.items())
    return "\n".join([*lines, "", f"Million pairs of neighbours a second at {rows[-1]['particles']:,}: {said}."])


def memory(rows: list[Run]) -> str:
    """Bytes a particle, and what a budget buys."""
    lines = [f"Bytes a particle, with the gradient of {rows[0]['steps']} steps ({rows[0]['memory']['how']}):", ""]
    lines += ["| particles | forward | with the gradient |", "|---|---|---|"]
    for row in rows:
        used = row["memory"]
        forward, gradient = used["forward_bytes_per_particle"], used["gradient_bytes_per_particle"]
        lines.append(f"| {row['particles']:,} | {forward:,.0f} | {gradient:,.0f} |")
    used = rows[-1]["memory"]
    counts = [1e-6 * 16e9 / used[f"{what}_bytes_per_particle"] for what in ("forward", "gradient")]
    return "\n".join([*lines, "", f"16 GB buy {counts[0]:.2g} million particles forward, {counts[1]:.2g} with it."])


def rewritten(page: str, name: str, text: str) -> str:
    """The document with what stands between the comments of a kind replaced."""
    begin, end = f"<!-- {name}: written by benchmarks/figures.py -->", f"<!-- end of {name} -->"
    if begin not in page or end not in page:
        sys.exit(f"{PAGE.name} has no place for {name}.")
    return re.sub(f"{re.escape(begin)}.*?{re.escape(end)}", lambda _: f"{begin}\n{text}\n{end}", page, flags=re.DOTALL)


def wrapped(text: str) -> str:
    """The same with sentences, but not rows of tables, in lines of 120 characters."""
    return "\n".join(line if line.startswith("|") else fill(line, 120) for line in text.split("\n"))


def main() -> None:
    runs = [shown(json.loads(Path(file).read_text())["runs"]) for file in sys.argv[1:]]
    last = {kind(run): run for run in runs}
    page = PAGE.read_text(encoding="utf-8")
    for name in ("cpu", "gpu"):
        if name in last:
            picture = f"images/performance_{name}.png"
            draw(last[name], DOCS / picture)
            text = wrapped(tables(last[name]))
            page = rewritten(page, name, f"![Milliseconds a step over particles]({picture})\n\n{text}")
        else:
            page = rewritten(page, name, MISSING)
    PAGE.write_text(page, encoding="utf-8")
    print(f"{PAGE} is rewritten")


if __name__ == "__main__":
    main()
