"""A measured wave flume: from the record of its flap to waves at its probes, and to the loads on a ship's section.

    python examples/wave_flume/wave_flume.py                                                 # minutes on a laptop
    python examples/wave_flume/wave_flume.py --deep 100 --long 13.63 --device cuda:0         # a minute on an H200
    python examples/wave_flume/wave_flume.py RECORD.csv --hull HULL.csv --draught 0.15 --at 5.5 ...

The flume is 13.63 m long and filled 1 m deep (Sundsdal, Greco, Hanssen and Lugni 2025, Ocean Engineering; CC0). A flap
above a sill, hinged 0.1 m above the floor, makes waves, and a beach takes them away. A record is a CSV file with the
columns `time_s` and `wavemaker_m`, the flap's displacement at the surface, positive away from the water. Waves at
`probe_1_m` and so on are compared, or else predicted. In a record with `fy_n`, `fz_n` and `mx_nm` the section of a ship
is held, and these are the loads on it. In one with `sway_m`, `heave_m` and `roll_rad` it moves, on springs that hold it
across, and these are its motions; those of a hull of your own are predicted.

Waves are compared with what was measured, and with linear theory of a flap that moves in any way (Dean and Dalrymple
1991), over the same nine seconds. See docs/wave_flume.md.
"""

import sys
import time
import warnings

import matplotlib.pyplot as plt
import numpy as np
import warp as wp
from case import LOADS, MOTIONS, parser_of, period, read, swing
from panels import LinearFlume
from section import DEPTH, GAUGE, GRAVITY, HINGE

import cortado
from cortado.sensors import SolidLoad, WaveGauge

FOOT, BEACH, NEAR = 0.05, 2.3, 6.0  # of the flap in its sill; of the beach; probes of the gain are nearer [m]
FEW = 20.0  # particles in the draught of a section that moves
SERIES = "measured", "here", "linear theory"


def beach(x, v, t, k, start, length):
    """The force of the beach, which takes velocities away, the further up the beach the more."""
    way = wp.max((x[0] - start) / length, 0.0)
    return -k * way * way * v


def flume(times, stroke, deep, long, section, hinge=HINGE):
    """A flume with ``deep`` particles in its depth; ``stroke`` (times,) is that of the flap at the surface [m]."""
    spacing, angle, arm = DEPTH / deep, -np.arctan2(stroke, DEPTH - hinge), np.array([-0.1, 0.5 * (1.3 - hinge - FOOT)])
    cos, sin = np.cos(angle), np.sin(angle)
    turned = np.stack([cos * arm[0] - sin * arm[1], sin * arm[0] + cos * arm[1]], axis=1)
    flap = {"name": "flap", "shape": "box", "lower": [-0.2, hinge - FOOT], "upper": [0.0, 1.3], "motion": "path"}
    sill = {"name": "sill", "shape": "box", "lower": [-0.4, -5.0 * spacing], "upper": [0.0, hinge]}
    flap |= {"times": times.tolist(), "positions": ([0.0, hinge] + turned).tolist(), "rotations": angle.tolist()}
    ship, springs = section.tables() if section else (None, [])
    return cortado.Scene(
        name="wave flume",
        dimension=2,
        discretisation={"spacing": spacing},
        phase=[{"name": "water", "rest_density": 1000.0, "viscosity": 0.001}],
        fluid=[{"shape": "box", "lower": [0.0, 0.0], "upper": [long, DEPTH], "phase": "water"}],
        container={"shape": "box", "lower": [-0.8, 0.0], "upper": [long, 2.0]},
        solid=[*([sill] if hinge else []), flap, *([ship] if section else [])],
        spring=springs,
        solver={"kind": "projection", "time_step": 0.1 * spacing},
    )


def simulated(times, stroke, places, asked, section=None, often=None, hinge=HINGE):
    """The run of a flume by the stroke of its flap, with gauges at places, and with a frame every ``often`` [s]."""
    step = 0.1 / asked.deep
    force = cortado.forces.Body(beach, k=6.0, start=asked.long - BEACH, length=BEACH)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", cortado.CortadoWarning)  # the limit "solids" is of water that falls: none does
        scene = flume(times, stroke, asked.deep, asked.long, section, hinge)
        simulation = cortado.Simulation(scene, device=asked.device, forces=[force])
        sensors = {f"{place:g}": WaveGauge([place, 0.0], radius=2.0 / asked.deep) for place in places}
        sensors |= {"load": SolidLoad("section")} if section and not section.rig else {}
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


def theory(times, stroke, places, length=40.0, modes=4000, hinge=HINGE):
    """The surface (times, places) [m] by linear theory in a long channel, mode by mode: E'' + w^2 E = S stroke''."""
    k = np.arange(modes) * np.pi / length
    w, y = np.sqrt(GRAVITY * k * np.tanh(k * DEPTH)), np.linspace(hinge, DEPTH, 1001)
    profile = np.exp(np.multiply.outer(k, y - DEPTH)) + np.exp(-np.multiply.outer(k, y + DEPTH))
    profile /= (1.0 + np.exp(-2.0 * k * DEPTH))[:, None]
    source = np.trapezoid((y - hinge) / (DEPTH - hinge) * profile, y, axis=1)
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
    parser = parser_of(__doc__)
    parser.add_argument("--deep", type=int, default=20, help="particles in the depth")
    parser.add_argument("--long", type=float, default=8.0, help="length of the flume [m]")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--film", action="store_true", help="write wave_flume.mp4 too")
    asked = parser.parse_args()
    try:
        return asked, read(asked).within(asked.long, asked.long - BEACH)
    except (OSError, ValueError) as wrong:
        parser.error(str(wrong))


def main():
    """Run the flume, print what its probes say, and draw it."""
    asked, case = arguments()
    asked.end, times, late, places = case.end, case.times, case.late, list(case.probes.values())
    measured, section = case.columns(case.probes), case.section
    often = 0.04 if asked.film or (section and section.rig) else None
    if section and section.rig and section.draught * asked.deep / DEPTH < FEW:
        many = section.draught * asked.deep / DEPTH
        print(f"there are {many:.2g} particles in the draught, few for motions: compare them with linear theory")
    run = simulated(times, case.stroke, places, asked, section, often, asked.hinge)
    here = surface(run, times, places)
    if section:
        linear, by_theory = LinearFlume(places, section, hinge=asked.hinge).answers(case.stroke)
    else:
        linear, by_theory = theory(times, case.stroke, np.array(places), hinge=asked.hinge), []

    long, has_measured = period(times, case.stroke), np.isfinite(measured).all()
    other, name = (measured, "measured") if section and has_measured else (linear, "theory")
    print(f"{run.positions.shape[1]:,} particles, waves of {long:.3f} s, from {case.begin:g} to {case.end:g} s")
    print(f"probe [m]  measured [mm]  linear theory [mm]  here [mm]  here / {name}  phase after {name} [deg]")
    for n, place in enumerate(places):
        own, true = (swing(times[late], each[late, n], long) for each in (here, other))
        tall = [2e3 * abs(swing(times[late], each[late, n], long)) for each in (measured, linear, here)]
        print(f"{place:9.2f}  {tall[0]:13.1f}  {tall[1]:18.1f}  {tall[2]:9.1f}".replace("nan", "  -"), end="")
        print(f"{abs(own / true):{9 + len(name)}.3f}{np.degrees(np.angle(true / own)):{20 + len(name)}.1f}")
    near = [n for n, place in enumerate(places) if place < NEAR and np.isfinite(measured[:, n]).all()]
    if near:
        factor, noise, bar = gain(measured[late][:, near], here[late][:, near], round(long / 0.02))
        same = np.corrcoef(measured[late][:, near].ravel(), here[late][:, near].ravel())[0, 1]
        print(f"what was measured is {factor:.3f} of this, within {bar:.3f} (of noise {noise:.3f})", end="; ")
        print(f"correlation {same:.3f}")
    heights = 1e3 * np.stack([measured.T, here.T, linear.T], axis=1)
    rows = {f"{place:g} m [mm]": each for place, each in zip(places, heights, strict=True)}
    for n, (name, one) in enumerate(on_section(run, section).items() if section else ()):
        rows[name] = case.columns([name])[:, 0], np.interp(times, *one), by_theory[:, n]
        true, own, expected = (swing(times[late], each[late], long) for each in rows[name])
        is_known = np.isfinite(true)
        beside, what = (true, "measured") if is_known else (expected, "theory")
        known = f"{abs(true):.4g} measured, mean {rows[name][0][late].mean():.3g}; " if is_known else ""
        print(f"{name}: {abs(own):.4g} here, mean {rows[name][1][late].mean():.3g}; {known}", end="")
        print(f"{abs(expected):.4g} in linear theory; here / {what} {abs(own / beside):.3f}", end=", ")
        print(f"{np.degrees(np.angle(beside / own)):.0f} degrees after it")
    draw(times, rows, case.end)
    names = [f"{name}, {what}" for name, each in rows.items() for what, _ in zip(SERIES, each, strict=False)]
    table = np.stack([times, *(one for each in rows.values() for one in each)], axis=1)
    np.savetxt("wave_flume.csv", table, "%.6g", ",", header=",".join(["time [s]", *names]), comments="")
    print("wave_flume.png and wave_flume.csv have these series")
    if asked.film:
        run.film("wave_flume.mp4", device=asked.device, width=1280, height=240, film_frames=150)
    assert not near or same > 0.8, "the waves are not those that were measured"


def on_section(run, section):
    """The times and values of the loads on the section, or of its motions, by the names that records have for them."""
    if section.rig:
        ship = run.solids["section"]
        moved = *(ship.positions - ship.positions[0]).T, ship.rotations
        return {name: (run.times, one) for name, one in zip(MOTIONS, moved, strict=True)}
    load, above = run.sensors["load"], section.keel[1] + GAUGE - section.middle[1]
    loads = load["force_x"], load["force_y"], load["torque"] + above * load["force_x"]
    return {name: (load.times, section.breadth * one) for name, one in zip(LOADS, loads, strict=True)}


def draw(times, series, end, path="wave_flume.png"):
    """Draw what was measured, what is here, and at probes linear theory, over time: a row each, by its name."""
    styles = list(zip(SERIES, ("0.65", "tab:blue", "tab:orange"), (3.0, 1.2, 1.0), (1, 3, 2), strict=True))
    figure, axes = plt.subplots(len(series), sharex=True, squeeze=False, figsize=(9.0, 1.4 * len(series) + 0.7))
    for row, (name, each) in zip(axes[:, 0], series.items(), strict=True):
        for one, (label, colour, width, order) in zip(each, styles, strict=False):
            if np.isfinite(one).any():
                row.plot(
                    times[times <= end], one[times <= end], color=colour, linewidth=width, label=label, zorder=order
                )
        row.set(ylabel=name, xlim=(min(3.0, 0.2 * end), end))
    axes[-1, 0].set_xlabel("time [s]")
    shown = {label: line for row in axes[:, 0] for line, label in zip(*row.get_legend_handles_labels(), strict=True)}
    figure.legend(shown.values(), shown, loc="upper center", ncols=3)
    figure.tight_layout(rect=(0.0, 0.0, 1.0, 1.0 - 0.4 / figure.get_figheight()))
    figure.savefig(path, dpi=150)


if __name__ == "__main__":
    main()
