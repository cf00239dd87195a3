"""A case of the flume: the record of a flap, places of probes, and a section if there is one; and its options."""

import argparse
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from section import DEPTH, HELD, HINGE, MEASURED, Rig, Section

BEGIN, END, STEP, SHORTEST = 13.0, 22.0, 0.02, 4.0  # when waves are compared [s], samples [s], at least so long [s]
PROBES = {"probe_1_m": 3.0, "probe_2_m": 4.95, "probe_3_m": 5.2, "probe_4_m": 5.5, "probe_6_m": 8.5}  # [m]
LOADS, MOTIONS = ("fy_n", "fz_n", "mx_nm"), ("sway_m", "heave_m", "roll_rad")


@dataclass
class Case:
    """A flap's ``stroke`` (times,) at the surface, towards the water [m], probes' places by name [m], and a section.

    ``measured`` has the columns (times,) of the record by name; what was not measured is nan.
    """

    times: np.ndarray
    stroke: np.ndarray
    measured: dict
    probes: dict
    section: Section | None
    begin: float = BEGIN
    end: float = END

    @property
    def late(self):
        """The times that are compared (times,)."""
        return (self.times >= self.begin) & (self.times <= self.end)

    @property
    def on_section(self):
        """The names of the loads on the section, or of its motions."""
        return () if self.section is None else MOTIONS if self.section.rig else LOADS

    def columns(self, names):
        """What was measured (times, names)."""
        nothing = np.full(len(self.times), np.nan)
        return np.stack([self.measured.get(name, nothing) for name in names], axis=1)

    def within(self, long=np.inf, shore=np.inf):
        """The same in a flume so long, whose beach begins at ``shore`` [m]: without probes there and in the section,
        which are said."""
        edges = [one.place + end for one in [self.section] if one for end in (one.left, one.right)]
        if edges and not 0.0 < edges[0] < edges[1] < long:
            raise ValueError(
                f"The section, from {edges[0]:.3g} to {edges[1]:.3g} m, is not between the flap and {long:g} m."
            )
        inside = [one for one in self.probes.values() if edges and edges[0] <= one <= edges[1]]
        out = [one for one in self.probes.values() if one <= 0.0 or one >= shore or one in inside]
        if out:
            where = ", ".join(f"{one:g}" for one in out)
            print(f"probes left out, on the beach, in the section or behind the flap: {where} m")
        if len(out) == len(self.probes):
            raise ValueError(f"No probe is left: the beach begins at {shore:g} m.")
        return replace(self, probes={name: one for name, one in self.probes.items() if one not in out})


def period(times, stroke):
    """The period [s] with which two harmonics come nearest to the record of the flap, where the first is greatest."""
    late = times >= min(8.0, 0.5 * times[-1])
    tried = np.linspace(0.6, 2.5, 1901)
    most = tried[np.argmax([abs(swing(times[late], stroke[late], one)) for one in tried])]
    near = tried[np.abs(tried / most - 1.0) < 0.1]
    return near[np.argmin([harmonics(times[late], stroke[late], one)[1] for one in near])]


def swing(times, values, long):
    """The complex amplitude of a series at a period ``long`` [s], beside its mean and its second harmonic."""
    (a, b, *_), _ = harmonics(times, values, long)
    return a - 1j * b


def harmonics(times, values, long):
    """The cosine and sine of a period ``long`` [s] and of its half, and the mean; and the squares that are left."""
    turn = 2.0 * np.pi * times / long
    waves = np.stack([np.cos(turn), np.sin(turn), np.cos(2.0 * turn), np.sin(2.0 * turn), np.ones_like(turn)], axis=1)
    found = np.linalg.lstsq(waves, values, rcond=None)[0]
    return found, ((values - waves @ found) ** 2).sum()


def table(path, wanted):
    """The columns of a CSV file by name, which has those that are wanted."""
    try:
        found = np.atleast_1d(np.genfromtxt(path, delimiter=",", names=True, encoding="utf-8-sig"))
    except (ValueError, UnicodeDecodeError):
        raise ValueError(f"{path} is no table of numbers with a line of names.") from None
    names = found.dtype.names or ()
    for name in wanted:
        if name not in names:
            raise ValueError(f"{path} has the columns {', '.join(names)}, but must have {', '.join(wanted)}.")
        if not np.isfinite(found[name]).all():
            raise ValueError(f"{path} has a line without a number in its column {name}.")
    return {name: found[name] for name in names}


def record_of(path):
    """The times of a record, every 0.02 s, the flap's way from where it begins, away from the water, and all columns.

    What is taken off is said.
    """
    found = table(path, ("time_s", "wavemaker_m"))
    own, way = found.pop("time_s"), found["wavemaker_m"]
    if len(own) < 2 or (np.diff(own) <= 0.0).any():
        raise ValueError(f"{path} wants two lines or more, with times that grow.")
    if way[0] or own[0]:
        print(f"taken off, so that the flap begins upright at 0 s: {1e3 * way[0]:.4g} mm and {own[0]:g} s")
    times = STEP * np.arange(int((own[-1] - own[0]) / STEP + 1e-6) + 1)
    columns = {name: np.interp(times, own - own[0], one) for name, one in found.items()}
    return times, columns["wavemaker_m"] - way[0], columns


def read(asked):
    """The case that options ask for; `ValueError` says in a sentence what is wrong."""
    times, way, measured = record_of(asked.record)
    probes = PROBES
    if asked.probes:
        probes = {f"probe_{n}_m": place for n, place in enumerate(asked.probes, 1)}
    case = Case(times, -asked.gain * way, measured, probes, chosen(asked, measured), asked.begin, asked.end)
    if times[-1] < case.end - 1e-9:
        print(f"the record ends at {times[-1]:.2f} s, and so does this, before {case.end:g} s")
        case.end = times[-1]
    if case.end - case.begin < SHORTEST:
        raise ValueError(
            f"Waves are compared from --begin, {case.begin:g} s, to {case.end:g} s, but must be for {SHORTEST:g} s or "
            f"more: give --begin {max(case.end - 9.0, 0.5 * case.end):.3g}."
        )
    if not 0.0 <= asked.hinge < DEPTH:
        raise ValueError(f"--hinge is {asked.hinge:g} m, but must be from 0 to less than {DEPTH:g} m.")
    return case


def chosen(asked, measured):
    """The section that options ask for, or else that of the authors where a record has loads or motions."""
    own = {
        name: getattr(asked, name) for name in ("draught", "at", "centre", "gyration", "breadth", "springs", "damping")
    }
    given = {name for name, one in own.items() if one is not None}
    moves = "heave_m" in measured or "fz_n" not in measured
    if asked.hull is None:
        if given:
            raise ValueError(f"--{min(given)} is of a hull of your own: give --hull HULL.csv too.")
        return None if not {"heave_m", "fz_n"} & set(measured) else MEASURED if moves else HELD
    wanted = ["draught", "at", *(["centre", "gyration"] if moves else [])]
    if missing := [f"--{name}" for name in wanted if name not in given]:
        raise ValueError(f"With --hull, {' and '.join(missing)} {'is' if len(missing) == 1 else 'are'} wanted too.")
    corners = table(asked.hull, ("x_m", "y_m"))
    rig = Rig(asked.centre, asked.gyration, asked.springs or 0.0, asked.damping or 0.0) if moves else None
    hull = np.stack([corners["x_m"], corners["y_m"]], axis=1)
    section = Section(hull, asked.draught, asked.at, 1.0 if asked.breadth is None else asked.breadth, rig)
    print(
        f"the hull displaces {section.mass:.2f} kg, {section.mass / section.breadth:.2f} kg for each metre of breadth"
    )
    if moves:
        metacentre = section.stiffness(rig.gravity_centre)[1, 1] / (section.area * section.breadth)
        print(f"its metacentre is {1e3 * metacentre:.0f} mm over its centre of gravity", end="")
        print("" if metacentre > 0.0 else ": it capsizes")
    return section


def parser_of(words):
    """A parser with the options that the scripts share."""
    parser = argparse.ArgumentParser(description=words, formatter_class=argparse.RawDescriptionHelpFormatter)
    default = Path(__file__).parent / "1062.csv"
    parser.add_argument("record", type=Path, nargs="?", default=default, help="a CSV file with time_s and wavemaker_m")
    parser.add_argument("--gain", type=float, default=1.0, help="the flap moves by so many times its record")
    parser.add_argument("--hinge", type=float, default=HINGE, help="height of the flap's hinge over the floor [m]")
    parser.add_argument("--begin", type=float, default=BEGIN, help="from when on waves are compared [s]")
    parser.add_argument("--end", type=float, default=END, help="until when [s]")
    parser.add_argument("--probes", type=float, nargs="+", help="places of probe_1_m, probe_2_m and so on [m]")
    hull = parser.add_argument_group("a hull of your own")
    hull.add_argument("--hull", type=Path, help="a CSV file of its corners, with x_m and y_m")
    hull.add_argument("--draught", type=float, help="[m]")
    hull.add_argument("--at", type=float, help="where its x = 0 is, from the flap [m]")
    hull.add_argument("--centre", type=float, help="height of its centre of gravity over its lowest point [m]")
    hull.add_argument("--gyration", type=float, help="its radius of gyration [m]")
    hull.add_argument("--breadth", type=float, help="its length across the flume [m], 1 if left out")
    hull.add_argument("--springs", type=float, help="stiffness that holds it across, of the whole breadth [N/m]; 0")
    hull.add_argument("--damping", type=float, help="of the rig, across and up, of the whole breadth [N s/m]; 0")
    return parser
