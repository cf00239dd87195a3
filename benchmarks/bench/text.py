"""Measurements as tables."""

from collections.abc import Mapping
from typing import Any

_HEAD = f"{'':24}{'launches':>9}{'ms a step':>12}{'floor':>12}{'x floor':>9}{'pairs / s':>12}"


def as_text(found: Mapping[str, Any]) -> str:
    """What `python -m benchmarks bench` prints: a block for each size."""
    around = found["environment"]
    busy = around["cores_busy_elsewhere"]
    others = "" if busy is None else f", {busy:g} of them busy with other processes"
    lines = [
        f"{around['device']}, {around['cores']} cores{others}; Warp {around['warp']}",
        f"copy bandwidth {found['copy_bandwidth_gb_per_s']:.4g} GB/s, "
        f"an empty launch {found['empty_launch_us']:.3g} us",
    ]
    for row in found["sizes"]:
        lines += ["", *_block(row)]
    return "\n".join(lines)


def reference_as_text(found: Mapping[str, Any]) -> str:
    """The same of the reference engine."""
    blocks = ("\n".join(f"{name:32} {_shown(value)}" for name, value in row.items()) for row in found["sizes"])
    return "\n\n".join(blocks)


def _block(row: Mapping[str, Any]) -> list[str]:
    memory = row["memory"]
    return [
        f"{row['particles']:,} particles, {row['neighbours_per_particle']:.1f} neighbours each, "
        f"{row['solver']}, {row['iterations_per_step']} iterations, {row['precision']}; medians of {row['repeats']} x "
        f"{row['steps']} steps",
        _HEAD,
        *(_line(one) for one in row["passes"]),
        *(_line({"name": name, **row[name]}) for name in ("step", "rollout")),
        *(_line(one) for one in row["adjoint_passes"]),
        _line({"name": "gradient", **row["gradient"]}),
        f"bytes a particle: {memory['forward_bytes_per_particle']:,.0f} forward, "
        f"{memory['gradient_bytes_per_particle']:,.0f} with the gradient of {row['steps']} steps ({memory['how']})",
    ]


def _line(one: Mapping[str, Any]) -> str:
    times = one["ms"] / one["floor_ms"]
    pairs = f"{one['pairs_per_second']:12.3g}" if "pairs_per_second" in one else ""
    return f"{one['name']:24}{one.get('launches', ''):>9}{one['ms']:12.4g}{one['floor_ms']:12.4g}{times:9.1f}{pairs}"


def _shown(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
