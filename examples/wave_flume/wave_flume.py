"""A measured wave flume: from the record of its flap to waves at its probes, and to the loads on a ship's section.

    python examples/wave_flume/wave_flume.py                                                 # minutes on a laptop
    python examples/wave_flume/wave_flume.py --deep 100 --long 13.63 --device cuda:0         # a minute on an H200
    python examples/wave_flume/wave_flume.py RECORD.csv --gain 1.11 ...

The flume is 13.63 m long and filled 1 m deep (Sundsdal, Greco, Hanssen and Lugni 2025, Ocean Engineering; CC0). A flap
above a sill, hinged 0.1 m above the floor, makes waves, and a beach takes them away. A record is a CSV file with the
columns `time_s`, `wavemaker_m`, the flap's displacement at the surface, positive away from the water, `probe_1_m` and
so on. In one with `fy_n`, `fz_n` and `mx_nm` the section of a ship is held at 7 m, and these are the loads on it. In
one with `sway_m`, `heave_m` and `roll_rad` it moves, on springs that hold it across, and these are its motions.

Waves are compared with what was measured, and with linear theory of a flap that moves in any way (Dean and Dalrymple
1991), over the same nine seconds. See docs/wave_flume.md.
"""

import argparse
import sys
import time
import warnings
from dataclasses import dataclass
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import warp as wp

import cortado
from cortado.sensors import SolidLoad, WaveGauge

DEPTH, HINGE, FOOT, GRAVITY = 1.0, 0.1, 0.05, 9.81  # water, hinge, how far the flap reaches into its sill [m]; [m/s2]
PROBES = {"probe_1_m": 3.0, "probe_2_m": 4.95, "probe_3_m": 5.2, "probe_4_m": 5.5, "probe_6_m": 8.5}  # [m]
BEACH = 2.3  # length of the beach [m]
LOADS, MOTIONS = ("fy_n", "fz_n", "mx_nm"), ("sway_m", "heave_m", "roll_rad")
BEGIN, END = 13.0, 22.0  # the time in which waves are compared [s]
SECTION, BEAM, DRAUGHT, HIGH, BILGE, BREADTH = 7.0, 0.4, 0.2, 0.256, 0.0512, 0.586  # place and sizes of the section [m]
GAUGE, LINE = 0.33, 20.0  # height of the load cell over the keel, lines so long that they stay level [m]


@dataclass
class Rig:
    """The weights of a section that floats, and what holds it."""

    gravity_centre: float  # height over the keel [m]
    gyration: float  # radius [m]
    stiffness: float  # of the springs across [N/m]
    damping: float  # across and up [N s/m]


TOLD = Rig(0.108, 0.144, 60.0, 8.7)  # by those who measured


def beach(x, v, t, k, start, length):
    """The force of the beach, which takes velocities away, the further up the beach the more."""
    way = wp.max((x[0] - start) / length, 0.0)
    return -k * way * way * v


def hull():
    """The section of the ship: a polygon with round bilges, the keel at the bottom."""
    arc = np.linspace(0.0, 0.5 * np.pi, 9)[:, None]
    left = [0.5 * BEAM - BILGE, BILGE] + BILGE * np.concatenate([np.sin(arc), -np.cos(arc)], axis=1)
    half = np.concatenate([left, [[0.5 * BEAM, HIGH]]])
    return (np.concatenate([half, half[::-1] * [-1.0, 1.0]]) + [SECTION, DEPTH - DRAUGHT]).tolist()


def middle_of(corners):
    """The centroid of a polygon."""
    x, y = np.array(corners).T
    area = x * np.roll(y, -1) - np.roll(x, -1) * y
    return [(area * (a + np.roll(a, -1))).sum() / (3.0 * area.sum()) for a in (x, y)]


def section(rig):
    """The section of the ship, which is held without a rig, and its springs, for each metre of breadth."""
    own = {"name": "section", "shape": "polygon", "corners": hull()}
    if rig is None:
        return {**own, "motion": "path", "velocity": [0.0, 0.0]}, []
    centre, middle = [SECTION, DEPTH - DRAUGHT + rig.gravity_centre], middle_of(hull())
    mass = 1000.0 * (BEAM * DRAUGHT - (2.0 - 0.5 * np.pi) * BILGE**2)  # of the water that it displaces
    own |= {"motion": "free", "mass": mass, "gyration_radius": rig.gyration}
    own |= {"centre_of_mass": [a - b for a, b in zip(centre, middle, strict=True)]}
    holds = {"solid": "section", "point": centre, "damping": rig.damping / BREADTH}
    across = {**holds, "name": "across", "anchor": [SECTION + LINE, centre[1]], "stiffness": rig.stiffness / BREADTH}
    return own, [across, {**holds, "name": "up", "anchor": [SECTION, centre[1] + LINE], "stiffness": 1e-3}]


def flume(times, stroke, deep, long, has_section, rig):
    """A flume with ``deep`` particles in its depth; ``stroke`` (times,) is that of the flap at the surface [m]."""
    spacing, angle, arm = DEPTH / deep, -np.arctan2(stroke, DEPTH - HINGE), np.array([-0.1, 0.5 * (1.3 - HINGE - FOOT)])
    cos, sin = np.cos(angle), np.sin(angle)
    turned = np.stack([cos * arm[0] - sin * arm[1], sin * arm[0] + cos * arm[1]], axis=1)
    flap = {"name": "flap", "shape": "box", "lower": [-0.2, HINGE - FOOT], "upper": [0.0, 1.3], "motion": "path"}
    sill = {"name": "sill", "shape": "box", "lower": [-0.4, -5.0 * spacing], "upper": [0.0, HINGE]}
    flap |= {"times": times.tolist(), "positions": ([0.0, HINGE] + turned).tolist(), "rotations": angle.tolist()}
    ship, springs = section(rig) if has_section else (None, [])
    return cortado.Scene(
        name="wave flume",
        dimension=2,
        discretisation={"spacing": spacing},
        phase=[{"name": "water", "rest_density": 1000.0, "viscosity": 0.001}],
        fluid=[{"shape": "box", "lower": [0.0, 0.0], "upper": [long, DEPTH], "phase": "water"}],
        container={"shape": "box", "lower": [-0.8, 0.0], "upper": [long, 2.0]},
        solid=[sill, flap, *([ship] if has_section else [])],
        spring=springs,
        solver={"kind": "projection", "time_step": 0.1 * spacing},
    )


def simulated(times, stroke, places, asked, has_section=False, rig=None, often=None):
    """The run of a flume by the stroke of its flap, with gauges at places, and with a frame every ``often`` [s]."""
    step = 0.1 / asked.deep
    force = cortado.forces.Body(beach, k=6.0, start=asked.long - BEACH, length=BEACH)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", cortado.CortadoWarning)  # the limit "solids" is of water that falls: none does
        scene = flume(times, stroke, asked.deep, asked.long, has_section, rig)
        simulation = cortado.Simulation(scene, device=asked.device, forces=[force])
        sensors = {f"{place:g}": WaveGauge([place, 0.0], radius=2.0 / asked.deep) for place in places}
        sensors |= {"load": SolidLoad("section")} if has_section and rig is None else {}
        frames, steps = 10**9 if often is None else max(round(often / step), 1), round(asked.end / step)
        return simulation.run(steps, record_every=frames, sensors=sensors, observe=told(steps))


def told(steps, every=10.0):
    """A function of the number of a step, which says every so many seconds how far a run is."""
    begun = last = None

    def tell(step):
        nonlocal begun, last
        now = time.monotonic()
        begun, last = begun or (step, now), last or now  # the first step compiles kernels
        if now - last > every:
            left = (now - begun[1]) * (steps - step) / (step - begun[0])
            print(f"step {step:,} of {steps:,}, about {left:.0f} s left", file=sys.stderr, flush=True)
            last = now

    return tell


def surface(run, times, places):
    """The surface (times, places) [m] over its rest in a run of `simulated`."""
    gauges = [run.sensors[f"{place:g}"] for place in places]
    return np.stack([np.interp(times, gauge.times, gauge["height"]) - DEPTH for gauge in gauges], axis=1)


def theory(times, stroke, places, length=40.0, modes=4000):
    """The surface (times, places) [m] by linear theory in a long channel, mode by mode: E'' + w^2 E = S stroke''."""
    k = np.arange(modes) * np.pi / length
    w, y = np.sqrt(GRAVITY * k * np.tanh(k * DEPTH)), np.linspace(HINGE, DEPTH, 1001)
    profile = np.exp(np.multiply.outer(k, y - DEPTH)) + np.exp(-np.multiply.outer(k, y + DEPTH))
    profile /= (1.0 + np.exp(-2.0 * k * DEPTH))[:, None]
    source = np.trapezoid((y - HINGE) / (DEPTH - HINGE) * profile, y, axis=1)
    parts = max(round((times[1] - times[0]) / 4e-3), 1)  # so many shorter steps in each
    fine = np.linspace(times[0], times[-1], parts * (len(times) - 1) + 1)
    step, speed = fine[1] - fine[0], np.gradient(np.interp(fine, times, stroke), fine)
    cos, sin = np.cos(w * step), np.sin(w * step) / np.where(w > 0.0, w, 1.0)
    level, rate, shapes = np.zeros(modes), np.zeros(modes), np.cos(np.multiply.outer(places, k))
    found = np.zeros((len(times), len(places)))
    for n in range(len(fine) - 1):
        push = 0.25 * step * (speed[n] + speed[n + 1]) * source
        level = level + push
        level, rate = cos * level + sin * rate, cos * rate - w * w * sin * level
        level = level + push
        if (n + 1) % parts == 0:
            found[(n + 1) // parts] = (level[0] + 2.0 * shapes[:, 1:] @ level[1:]) / length
    return found


def period(times, stroke):
    """The period [s] at which the record of the flap has most of its amplitude."""
    late = times >= 8.0
    tried = np.linspace(0.6, 2.5, 1901)
    return tried[np.argmax([abs(swing(times[late], stroke[late], one)) for one in tried])]


def swing(times, values, long):
    """The complex amplitude of a series at a period ``long`` [s], beside its mean and its second harmonic."""
    turn = 2.0 * np.pi * times / long
    waves = [np.cos(turn), np.sin(turn), np.cos(2.0 * turn), np.sin(2.0 * turn), np.ones_like(turn)]
    a, b, *_ = np.linalg.lstsq(np.stack(waves, axis=1), values, rcond=None)[0]
    return a - 1j * b


def gain(measured, found, block, draws=400):
    """The factor between two surfaces (times, probes), and its bars (two standard deviations): one of noise alone, and
    one of what the model lacks, by drawing residuals again in blocks of so many times."""
    factor = (measured * found).sum() / (found**2).sum()
    left, random = measured - factor * found, np.random.default_rng(0)
    noise = 2.0 * left.std() / np.sqrt((found**2).sum())
    starts = random.integers(0, len(left) - block, size=(draws, -(-len(left) // block)))
    drawn = np.stack([np.concatenate([left[s : s + block] for s in row])[: len(left)] for row in starts])
    return factor, noise, 2.0 * ((drawn * found).sum((1, 2)) / (found**2).sum()).std()


def arguments():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    default = Path(__file__).parent / "1062.csv"
    parser.add_argument("record", type=Path, nargs="?", default=default, help="a CSV file")
    parser.add_argument("--deep", type=int, default=20, help="particles in the depth")
    parser.add_argument("--long", type=float, default=8.0, help="length of the flume [m]")
    parser.add_argument("--begin", type=float, default=BEGIN, help="from when on waves are compared [s]")
    parser.add_argument("--end", type=float, default=END, help="when the run ends [s]")
    parser.add_argument("--gain", type=float, default=1.0, help="the flap moves by so many times its record")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--film", action="store_true", help="write wave_flume.mp4 too")
    asked = parser.parse_args()
    if asked.end - asked.begin < 4.0:
        parser.error(f"--begin is {asked.begin:g} s and --end {asked.end:g} s, but 4 s or more must be between them.")
    return asked


def main():
    """Run the flume, print what its probes say, and draw it."""
    asked = arguments()
    record = np.genfromtxt(asked.record, delimiter=",", names=True)
    times, stroke = record["time_s"], -asked.gain * record["wavemaker_m"]
    probes = {name: place for name, place in PROBES.items() if place < asked.long - BEACH}
    measured, names = np.stack([record[name] for name in probes], axis=1), record.dtype.names
    is_held, moves = "fz_n" in names, "heave_m" in names

    often = 0.04 if asked.film or moves else None
    run = simulated(times, stroke, probes.values(), asked, is_held or moves, TOLD if moves else None, often)
    here = surface(run, times, probes.values())
    linear = theory(times, stroke, np.array(list(probes.values())))

    long, late = period(times, stroke), (times >= asked.begin) & (times <= asked.end)
    other, name = (measured, "measured") if is_held or moves else (linear, "theory")  # which has no section
    print(f"{run.positions.shape[1]:,} particles, waves of {long:.3f} s, from {asked.begin:g} to {asked.end:g} s")
    print(f"probe [m]  measured [mm]  linear theory [mm]  here [mm]  here / {name}  phase after {name} [deg]")
    for n, place in enumerate(probes.values()):
        own, true = (swing(times[late], each[late, n], long) for each in (here, other))
        tall = [2e3 * abs(swing(times[late], each[late, n], long)) for each in (measured, linear, here)]
        print(f"{place:9.2f}  {tall[0]:13.1f}  {tall[1]:18.1f}  {tall[2]:9.1f}", end="")
        print(f"{abs(own / true):{9 + len(name)}.3f}{np.degrees(np.angle(true / own)):{20 + len(name)}.1f}")
    near = [n for n, place in enumerate(probes.values()) if place < 6.0]
    factor, noise, bar = gain(measured[late][:, near], here[late][:, near], round(long / 0.02))
    same = np.corrcoef(measured[late][:, near].ravel(), here[late][:, near].ravel())[0, 1]
    print(f"what was measured is {factor:.3f} of this, within {bar:.3f} (of noise {noise:.3f}); correlation {same:.3f}")
    section = {name: np.interp(times, *one) for name, one in on_section(run, is_held, moves).items()}
    for name, found in section.items():
        own, true = (swing(times[late], each[late], long) for each in (found, record[name]))
        print(f"{name}: {abs(own):.4g} here, {abs(true):.4g} measured, {abs(own / true):.3f} times;", end=" ")
        print(f"{np.degrees(np.angle(true / own)):.0f} degrees after, mean {found[late].mean():.3g} here, ", end="")
        print(f"{record[name][late].mean():.3g} measured")
    heights = 1e3 * np.stack([measured.T, here.T, linear.T], axis=1)
    rows = {f"{place:g} m [mm]": each for place, each in zip(probes.values(), heights, strict=True)}
    draw(times, rows | {name: (record[name], found) for name, found in section.items()}, asked.end)
    if asked.film:
        run.film("wave_flume.mp4", device=asked.device, width=1280, height=240, film_frames=150)
    assert same > 0.8, "the waves are not those that were measured"


def on_section(run, is_held, moves):
    """The times and values of the loads on the section, or of its motions, by the names that records have for them."""
    if moves:
        ship = run.solids["section"]
        moved = *(ship.positions - ship.positions[0]).T, ship.rotations
        return {name: (run.times, one) for name, one in zip(MOTIONS, moved, strict=True)}
    if not is_held:
        return {}
    load, above = run.sensors["load"], DEPTH - DRAUGHT + GAUGE - middle_of(hull())[1]
    loads = load["force_x"], load["force_y"], load["torque"] + above * load["force_x"]
    return {name: (load.times, BREADTH * one) for name, one in zip(LOADS, loads, strict=True)}


def draw(times, series, end, path="wave_flume.png"):
    """Draw what was measured, what is here, and at probes linear theory, over time: a row each, by its name."""
    styles = ("measured", "0.65", 3.0, 1), ("here", "tab:blue", 1.2, 3), ("linear theory", "tab:orange", 1.0, 2)
    figure, axes = plt.subplots(len(series), sharex=True, squeeze=False, figsize=(9.0, 1.4 * len(series) + 0.7))
    for row, (name, each) in zip(axes[:, 0], series.items(), strict=True):
        for one, (label, colour, width, order) in zip(each, styles[: len(each)], strict=True):
            row.plot(times[times <= end], one[times <= end], color=colour, linewidth=width, label=label, zorder=order)
        row.set(ylabel=name, xlim=(3.0, end))
    axes[-1, 0].set_xlabel("time [s]")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="upper center", ncols=3)
    figure.tight_layout(rect=(0.0, 0.0, 1.0, 1.0 - 0.4 / figure.get_figheight()))
    figure.savefig(path, dpi=150)


if __name__ == "__main__":
    main()
