"""Sensors read what a closed form says of a fluid that moves as a whole; one that can read nothing is told of."""

from pathlib import Path
from typing import Any

import numpy as np

import cortado
from cortado.sensors import FlowRate, WaveGauge
from fuzz.cases import Case
from fuzz.files import PLANE
from fuzz.oddities import Random
from fuzz.toml_text import to_toml

SPACING = 0.02
KERNELS = ("cubic_spline", "wendland_c2", "wendland_c4")
CLOSE = 0.02
"""Part by which a reading may be off: a gauge counts whole particles with smooth weights."""


def read_a_moving_fluid(case: Case) -> None:
    """A layer in a channel that is periodic along x goes around some times; depth and flow rate stay what they are."""
    random = case.random
    across, layers = int(random.integers(20, 41)), int(random.integers(8, 17))
    length, depth = across * SPACING, layers * SPACING
    origin = float(random.uniform(-3.0, 3.0))
    speed = float(random.choice([-1.0, 1.0]) * random.uniform(1.0, 4.0))
    rounds, steps = float(random.uniform(0.5, 2.5)), 240
    kernel, support = str(random.choice(KERNELS)), float(random.choice([2.0, 2.5, 3.0]))
    place = origin + length * float(random.choice([0.0, 1.0, random.uniform(), 0.01, 0.99]))
    block = {"shape": "box", "lower": [origin, 0.0], "upper": [origin + length, depth], "phase": "water"}
    tables = {
        **PLANE,
        "discretisation": {"spacing": SPACING, "kernel": kernel, "support": support},
        "fluid": [{**block, "velocity": [speed, 0.0]}],
        "container": {
            "shape": "box",
            "lower": [origin, 0.0],
            "upper": [origin + length, 1.0],
            "periodic": [True, False],
        },
        "forces": {"gravity": [0.0, 0.0], "pressure": False},
        "solver": {"time_step": rounds * length / abs(speed) / steps},
    }
    case.notes.append(
        f"{kernel} at {support}, {across} x {layers}, {rounds:.2f} times around, x = {place - origin:.3f}"
    )

    def compute(_: Path) -> None:
        sensors = {
            "gauge": WaveGauge([place, 0.0], radius=6.0 * SPACING),
            "flow": FlowRate([place, 0.0], [1.0, 0.0]),
        }
        run = cortado.Simulation(cortado.Scene(**tables)).run(steps, record_every=steps, sensors=sensors)
        for name, column, wanted in (("gauge", "height", depth), ("flow", "flow_rate", depth * speed)):
            read = run.sensors[name][column]
            off = np.abs(read / wanted - 1.0)
            if not (off < CLOSE).all():
                print(f"{name} reads {read[off.argmax()]:.5g} in step {off.argmax()}, but {wanted:.5g} is right")
                raise SystemExit(3)

    if case.read(compute, case.folder, codes=(0, 3)).code == 3:
        case.complaints.append(f"a sensor is wrong: {case.outcomes[-1].out.strip()}")


def place_a_sensor(case: Case) -> None:
    """A sensor at a place where fluid can never be is told of, by name; one in the fluid is not."""
    kind, place, radius, is_told = placed(case.random)
    block = {"shape": "box", "lower": [0.0, 0.0], "upper": [0.4, 0.3], "phase": "water"}
    stone = {"name": "stone", "shape": "box", "lower": [0.45, 0.1], "upper": [0.65, 0.5]}
    sensor: dict[str, Any] = {"kind": kind, "name": "here"}
    if kind == "wall_force":
        sensor |= {"lower": place, "upper": [one + 0.05 for one in place]}
    else:
        sensor |= {"position": place, **radius, **({"normal": [1.0, 0.0]} if kind == "flow_rate" else {})}
    container = {"shape": "box", "lower": [0.0, 0.0], "upper": [0.7, 0.8]}
    tables = {**PLANE, "fluid": [block], "solid": [stone], "container": container, "sensor": [sensor]}
    (case.folder / "scene.toml").write_text(to_toml(tables))
    case.notes.append(f"{kind} at {place} {radius}")
    outcome = case.cortado("run", "scene.toml", "--no-pictures", "--steps", "2", "--out", "out")
    said = any(line.startswith("Warning: ") and "here" in line for line in outcome.err.splitlines())
    if outcome.code == 0 and said != is_told:
        case.complaints.append(
            "a sensor that can read nothing is not told of" if is_told else "a good sensor is doubted"
        )


def placed(random: Random) -> tuple[str, list[float], dict[str, float], bool]:
    """The kind of a sensor in the scene of `place_a_sensor`, its place, its radius, and whether it can read nothing."""
    kind = str(random.choice(["pressure_probe", "wave_gauge", "flow_rate", "wall_force"]))
    inside = [float(random.uniform(0.05, 0.35)), float(random.uniform(0.05, 0.25))]
    where = int(random.integers(4))
    if kind == "wall_force":
        middle = [float(random.uniform(0.1, 0.3)), float(random.uniform(0.4, 0.6))]
        return kind, middle if where else [0.1, -0.02], {}, bool(where)
    if where == 0:
        return kind, inside, {}, False
    if where == 1 and kind == "pressure_probe":
        return kind, [float(random.uniform(0.53, 0.57)), float(random.uniform(0.25, 0.35))], {"radius": 0.05}, True
    if where == 2:
        return kind, inside, {"reach" if kind == "flow_rate" else "radius": 1e-9}, True
    return kind, [1000.0 * one for one in inside], {}, True
