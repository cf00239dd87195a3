"""``python -m benchmarks bench``: a dam break, timed."""

import json
from collections.abc import Sequence
from typing import Any

import warp as wp

from benchmarks.bench.dam_break import measure_dam_break, with_floors
from benchmarks.bench.environment import OtherProcesses, environment
from benchmarks.bench.floor import copy_bandwidth
from benchmarks.bench.text import as_text, reference_as_text
from benchmarks.bench.timing import empty_launch_seconds
from cortado.device.launching import KernelLauncher


def bench_dam_break(
    particles: Sequence[int], steps: int, repeats: int, device: str, precision: str, solver: str, as_json: bool
) -> str:
    """Times and memory of each size, as text: passes of a step, the step, the rollout and the gradient, each beside
    what the hardware allows."""
    around, others = environment(), OtherProcesses()
    rows = [measure_dam_break(number, steps, device, precision, repeats, solver) for number in sorted(particles)]
    where = wp.get_device(device)
    # After the sizes, so that what is copied does not count as their memory.
    bandwidth = copy_bandwidth(where, repeats)
    empty = empty_launch_seconds(KernelLauncher(1, where, record_tape=False), repeats)
    device_name = around["processor"] if where.is_cpu else where.name
    found: dict[str, Any] = {
        "environment": {"device": device_name, **around, "cores_busy_elsewhere": others.busy_cores()},
        "copy_bandwidth_gb_per_s": 1e-9 * bandwidth,
        "empty_launch_us": 1e6 * empty,
        "sizes": [with_floors(row, bandwidth) for row in rows],
    }
    return json.dumps(found, indent=2) if as_json else as_text(found)


def bench_reference(particles: Sequence[int], steps: int, repeats: int, precision: str, as_json: bool) -> str:
    """Times of the reference engine, on one core and on all, as text."""
    from benchmarks.bench.reference_engine import measure_reference  # may not be installed

    around, others = environment(), OtherProcesses()
    rows = [measure_reference(number, steps, precision, repeats) for number in sorted(particles)]
    machine = {"device": around["processor"], **around, "cores_busy_elsewhere": others.busy_cores()}
    found = {"environment": machine, "sizes": rows}
    return json.dumps(found, indent=2) if as_json else reference_as_text(found)
