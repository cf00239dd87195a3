"""How many steps are taken between two looks of the host."""

from typing import Any

CHUNK = 64
"""Steps between two looks of the host, at most."""
FILLED = {"cpu": 32_000, "cuda": 16_000_000}
"""Particles in the steps of a chunk, beyond which a look of the host costs hardly anything beside them."""


def chunk_length(steps: int, particles: int, device: Any) -> int:
    """Of so many steps of so many particles, at least one."""
    filled = FILLED["cpu" if device.is_cpu else "cuda"] // max(particles, 1)
    return max(min(CHUNK, filled, steps), 1)
