"""What ``cortado describe`` says of an emitter: when it runs dry, and how fast fluid comes out of it."""

from typing import Any

from cortado.cli.commands.run_length import RunLength
from cortado.discretise.shapes import EXCESS
from cortado.scene.scene import Scene

SAME = 1e-6
"""Relative: a time step that is rounded to float32 is the same."""


def of_emitter(scene: Scene) -> dict[str, float | None]:
    """When all of it is out, how fast, and the areas that its particles' cells and its opening have."""
    emitter, spacing = scene.emitter, scene.discretisation.spacing
    if emitter is None:
        return {"emitter_runs_dry_at_s": None}
    areas = {"emitter_area": emitter.area(spacing), "emitter_area_asked": emitter.asked_area()}
    return {"emitter_runs_dry_at_s": emitter.dry_after(spacing), "emitter_speed_m_s": emitter.speed(spacing), **areas}


def emitter_rows(found: dict[str, Any], length: RunLength) -> list[tuple[str, str]]:
    """When all of it is out, whether that is before the end of the run, and how fast it comes."""
    dry = found["emitter_runs_dry_at_s"]
    if dry is None:
        return []
    given, asked = found["emitter_area"], found["emitter_area_asked"]
    speed = f"fluid comes out at {found['emitter_speed_m_s']:.3g} m/s"
    if abs(given - asked) > EXCESS * asked:
        unit = "m" if found["dimension"] == 2 else "m2"
        speed += f", through {given:.3g} {unit} of cells, where an opening of {asked:.3g} {unit} was asked for"
    if length.time is None or dry >= length.time * (1.0 - SAME):
        return [("emitter", f"has fluid for {dry:.4g} s; {speed}")]
    return [("emitter", f"runs dry at {dry:.4g} s, before the end of the run at {length.time:g} s; {speed}")]
