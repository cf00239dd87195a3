"""Linear theory of the whole flume with a section in it, which is held or floats: potential flow from panels.

    python examples/wave_flume/panels.py examples/wave_flume/2062.csv --gain 1.11     # seconds: loads, or motions

Amplitudes belong to exp(i w t), at frequencies with a small imaginary part, so that a series begins from rest. Around
the water there are straight panels, with one potential and one normal derivative q each, which Green's identity binds.
At the surface q is w^2 / g of the potential; at the end -i k of it, so that waves leave; the flap and the section tell
it their speed; the floor is a mirror. So waves go to and fro between flap and section as often as they do in the flume.
"""

import argparse
from itertools import pairwise
from pathlib import Path

import numpy as np
from wave_flume import (
    BEAM,
    BEGIN,
    BILGE,
    BREADTH,
    DEPTH,
    DRAUGHT,
    END,
    GAUGE,
    GRAVITY,
    HINGE,
    LOADS,
    MOTIONS,
    PROBES,
    SECTION,
    TOLD,
    hull,
    period,
    swing,
)

DENSITY, LEAVE, COARSE, FINE = 1000.0, 10.0, 0.04, 0.015  # [kg/m3], end of the water, panels, those of the section [m]
WINDOW, FADE, HIGHEST, STEP = 80.0, 4.0, 2.0, 0.02  # series [s], how they fade in it, frequencies [Hz], samples [s]
GUIDES, SLOW = 0.303, 2e-3  # what moves across with the section [kg]; where dry friction turns round [m/s]
NEAR, BESIDE, BEHIND = 5.5, 5.6, 8.5  # where waves before and behind the section are told apart [m]
AREA = BEAM * DRAUGHT - (2.0 - 0.5 * np.pi) * BILGE**2  # of the section under water [m2]


def split(corners, length):
    """The points (n, 2) along a line through corners, at most ``length`` [m] apart."""
    counts = [int(np.ceil(np.hypot(*np.subtract(b, a)) / length)) for a, b in pairwise(corners)]
    parts = [np.linspace(a, b, n + 1)[:-1] for (a, b), n in zip(pairwise(corners), counts, strict=True)]
    return np.concatenate([*parts, [corners[-1]]])


def outline(has_section):
    """The ends (2, n, 2) of all panels, counter-clockwise around the water, and what each of them is."""
    corner = [(LEAVE, DEPTH), (0.0, DEPTH)]
    lines = [("end", split([(LEAVE, 0.0), corner[0]], COARSE))]
    if has_section:
        under = [(SECTION + 0.5 * BEAM, DEPTH), *[one for one in hull()[::-1] if one[1] < DEPTH and one[0] > SECTION]]
        line = under + [(2.0 * SECTION - x, y) for x, y in under[::-1]]
        lines += [("top", split([corner[0], line[0]], COARSE)), ("hull", split(line, FINE))]
        lines += [("top", split([line[-1], corner[1]], COARSE))]
    else:
        lines += [("top", split(corner, COARSE))]
    lines += [("flap", split([corner[1], (0.0, 0.0)], COARSE))]
    kinds = np.concatenate([[kind] * (len(line) - 1) for kind, line in lines])
    return np.stack([np.concatenate([line[s] for _, line in lines]) for s in (slice(-1), slice(1, None))]), kinds


def influence(start, along, normal, size, middle):
    """What a unit of q, and of potential, on each panel makes at each middle: integrals of ln r and of its slope."""
    of_q, of_potential = np.zeros((2, len(size), len(size)))
    for mirror in (1.0, -1.0):
        apart = start - (middle * [1.0, mirror])[:, None]
        first, high = (apart * along).sum(2), (apart * normal).sum(2)
        last, high = first + size, np.where(np.abs(high) < 1e-9, 1e-9, high)
        angle = np.arctan(last / high) - np.arctan(first / high)
        if mirror > 0.0:
            np.fill_diagonal(angle, 0.0)
        of_potential += angle
        of_q += last * np.log(np.hypot(last, high)) - first * np.log(np.hypot(first, high)) - size + high * angle
    return of_q, of_potential - np.pi * np.eye(len(size))


def wave_number(w):
    """The k [1/m] of waves at a complex frequency: w^2 = g k tanh(k d)."""
    k = complex(max(abs(w) ** 2 / GRAVITY, abs(w) / np.sqrt(GRAVITY * DEPTH)))
    for _ in range(50):
        tanh = np.tanh(k * DEPTH)
        k -= (GRAVITY * k * tanh - w**2) / (GRAVITY * tanh + GRAVITY * k * DEPTH * (1.0 - tanh**2))
    return k


class LinearFlume:
    """What a flap, and sway, heave and roll about the keel, make of 1 m or 1 rad, at all frequencies.

    ``loads`` (n, 3, 4) [N, N m] are those on the section, about its keel, and ``surfaces`` (n, places, 4) [m].
    """

    def __init__(self, places, has_section=True):
        self.places = list(places)
        count = round(WINDOW / STEP)
        above = 2.0 * np.pi * np.fft.rfftfreq(count, STEP)
        self.rates = above[above < 2.0 * np.pi * HIGHEST] - 1j * FADE / WINDOW
        self.k = np.array([wave_number(w) for w in self.rates])
        (start, end), kinds = outline(has_section)
        middle, size = 0.5 * (start + end), np.hypot(*(end - start).T)
        along = (end - start) / size[:, None]
        normal = np.stack([along[:, 1], -along[:, 0]], axis=1)
        of_q, of_potential = influence(start, along, normal, size, middle)
        flap = np.where(kinds == "flap", -np.maximum(middle[:, 1] - HINGE, 0.0) / (DEPTH - HINGE), 0.0)
        x, y = (middle - [SECTION, DEPTH - DRAUGHT]).T
        modes = np.stack([*normal.T, x * normal[:, 1] - y * normal[:, 0]], axis=1) * (kinds == "hull")[:, None]
        moved, top = np.concatenate([flap[:, None], modes], axis=1), np.flatnonzero(kinds == "top")
        order = top[np.argsort(middle[top, 0])]
        self.loads = np.zeros((len(self.rates), 3, 4), dtype=complex)
        self.surfaces = np.zeros((len(self.rates), len(self.places), 4), dtype=complex)
        for n, (w, k) in enumerate(zip(self.rates, self.k, strict=True)):
            factor = np.where(kinds == "top", w**2 / GRAVITY, np.where(kinds == "end", -1j * k, 0.0))
            potential = np.linalg.solve(of_potential - of_q * factor, of_q @ (1j * w * moved))
            self.loads[n] = -DENSITY * 1j * w * BREADTH * (modes * size[:, None]).T @ potential
            here = -1j * w / GRAVITY * potential[order]
            self.surfaces[n] = np.stack([np.interp(self.places, middle[order, 0], one) for one in here.T], axis=1)

    def spectrum(self, series):
        """The amplitudes of a series of samples from rest."""
        faded = series * np.exp(-FADE / WINDOW * STEP * np.arange(len(series)))
        return np.fft.rfft(faded, round(WINDOW / STEP))[: len(self.rates)]

    def analytic(self, spectrum, count):
        """The analytic signals (count, ...) of amplitudes (n, ...): the series are their real parts."""
        twice = np.concatenate([spectrum[:1], 2.0 * spectrum[1:]])
        grown = np.exp(FADE / WINDOW * STEP * np.arange(count)).reshape(-1, *[1] * (spectrum.ndim - 1))
        return np.fft.ifft(twice, round(WINDOW / STEP), axis=0)[:count] * grown

    def series(self, spectrum, count):
        """The first samples (count, ...) of amplitudes (n, ...)."""
        return self.analytic(spectrum, count).real

    def response(self, rig, roll_damping=0.0):
        """What 1 N or 1 N m on a floating section moves it by, and what the flap pushes it with, at its centre."""
        lever = np.eye(3)
        lever[2, 0] = rig.gravity_centre
        around = lever @ self.loads[:, :, 1:] @ lever.T
        mass = DENSITY * AREA * BREADTH
        corners = 2.0 * BILGE**2 * (0.5 * BILGE - 0.25 * np.pi * BILGE + BILGE / 3.0)
        buoyancy_centre = (0.5 * BEAM * DRAUGHT**2 - corners) / AREA
        stable = BEAM**3 / 12.0 + AREA * (buoyancy_centre - rig.gravity_centre)
        inertia = np.diag([mass + GUIDES, mass, mass * rig.gyration**2])
        held = np.diag([rig.stiffness, DENSITY * GRAVITY * BREADTH * BEAM, DENSITY * GRAVITY * BREADTH * stable])
        w, damped = self.rates[:, None, None], np.diag([rig.damping, rig.damping, roll_damping])
        return np.linalg.inv(held + 1j * w * damped - w**2 * inertia - around), self.loads[:, :, 0] @ lever.T

    def motions(self, stroke, rig, roll_damping=0.0, friction=0.0):
        """Sway, heave and roll (times, 3) of a floating section, with drift and the dry friction [N] of its guides."""
        flap, count = self.spectrum(stroke), len(stroke)
        answer, pushed = self.response(rig, roll_damping)
        linear = np.einsum("nij,nj->ni", answer, pushed * flap[:, None])
        push = self.spectrum(self.drift(flap, linear, rig, count))
        if friction:
            free = self.series(1j * self.rates * (linear[:, 0] + answer[:, 0, 0] * push), count)
            push = push + self.spectrum(rubbed(free, self.series(1j * self.rates * answer[:, 0, 0], count), friction))
        return self.series(linear + answer[:, :, 0] * push[:, None], count)

    def drift(self, flap, linear, rig, count):
        """The slow force (times,) [N] across: the momentum that waves lose at the section (Longuet-Higgins 1977)."""
        keel = linear + np.stack([rig.gravity_centre * linear[:, 2], *np.zeros((2, len(linear)))], axis=1)
        surface = np.einsum("npj,nj->np", self.surfaces, np.concatenate([flap[:, None], keel], axis=1))
        near, beside, behind = (surface[:, self.places.index(place)] for place in (NEAR, BESIDE, BEHIND))
        turn, way = np.exp(-1j * self.k * (BESIDE - NEAR)), np.exp(-1j * self.k * (SECTION - NEAR))
        onward = (beside - near / turn) / (turn - 1.0 / turn)
        waves = np.stack([onward * way, (near - onward) / way, behind / way], axis=1)
        waves[np.abs(self.rates) < 2.0] = 0.0
        sent, back, passed = (np.abs(self.analytic(waves, count)) ** 2).T
        k = self.k[np.argmax(np.abs(flap))].real
        depth = 1.0 + 2.0 * k * DEPTH / np.sinh(2.0 * k * DEPTH)
        return 0.25 * DENSITY * GRAVITY * depth * BREADTH * (sent + back - passed)


def rubbed(free, kick, friction):
    """The dry friction (times,) [N] that slows what would move at ``free`` [m/s]; ``kick`` is what 1 N s does to it."""
    force = np.zeros(len(free))
    for n in range(len(free)):
        without = free[n] + kick[n:0:-1] @ force[:n]
        speed = without
        for _ in range(8):
            tanh = np.tanh(speed / SLOW)
            slope = 1.0 + kick[0] * friction * (1.0 - tanh**2) / SLOW
            speed -= (speed - without + kick[0] * friction * tanh) / slope
        force[n] = -friction * np.tanh(speed / SLOW)
    return force


def main():
    """Print what linear theory makes of a record beside what was measured."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("record", type=Path, help="a CSV file")
    parser.add_argument("--gain", type=float, default=1.0, help="the flap moves by so many times its record")
    asked = parser.parse_args()
    record = np.genfromtxt(asked.record, delimiter=",", names=True)
    times, stroke, names = record["time_s"], -asked.gain * record["wavemaker_m"], record.dtype.names
    flume = LinearFlume([*PROBES.values(), BESIDE], has_section="fz_n" in names or "heave_m" in names)
    flap, moved = flume.spectrum(stroke), np.zeros((len(flume.rates), 3))
    rows = {}
    if "heave_m" in names:
        answer, pushed = flume.response(TOLD)
        moved = np.einsum("nij,nj->ni", answer, pushed * flap[:, None])
        rows = dict(zip(MOTIONS, flume.motions(stroke, TOLD).T, strict=True))
        moved = moved + np.stack([TOLD.gravity_centre * moved[:, 2], *np.zeros((2, len(moved)))], axis=1)
    if "fz_n" in names:
        loads = flume.loads[:, :, 0] @ np.array([[1.0, 0.0, GAUGE], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]) * flap[:, None]
        rows = dict(zip(LOADS, flume.series(loads, len(times)).T, strict=True))
    surface = np.einsum("npj,nj->np", flume.surfaces, np.concatenate([flap[:, None], moved], axis=1))
    rows |= dict(zip(PROBES, flume.series(surface, len(times)).T, strict=False))
    long, late = period(times, stroke), (times >= BEGIN) & (times <= END)
    print(f"linear theory, waves of {long:.3f} s; amplitude, measured amplitude, ratio, phase after measured [deg]")
    for name, each in rows.items():
        own, true = (swing(times[late], one[late], long) for one in (each, record[name]))
        print(
            f"{name:10} {abs(own):9.4g} {abs(true):9.4g} {abs(own / true):6.3f} {np.degrees(np.angle(true / own)):6.1f}"
        )


if __name__ == "__main__":
    main()
