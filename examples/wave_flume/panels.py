"""Linear theory of the whole flume with a section in it, which is held or floats: potential flow from panels.

    python examples/wave_flume/panels.py examples/wave_flume/2062.csv --gain 1.11     # seconds: loads, or motions

Amplitudes belong to exp(i w t), at frequencies with a small imaginary part, so that a series begins from rest. Around
the water there are straight panels, with one potential and one normal derivative q each, which Green's identity binds.
At the surface q is w^2 / g of the potential; at the end -i k of it, so that waves leave; the flap and the section tell
it their speed; the floor is a mirror. So waves go to and fro between flap and section as often as they do in the flume.
"""

from itertools import pairwise

import numpy as np
from case import parser_of, period, read, swing
from section import DENSITY, DEPTH, GAUGE, GRAVITY, HINGE

LEAVE, COARSE, FINE = 10.0, 0.04, 0.015  # least way to the end of the water, panels, those of the section [m]
WINDOW, FADE, HIGHEST, STEP = 80.0, 4.0, 2.0, 0.02  # series [s], how they fade in it, frequencies [Hz], samples [s]
SLOW, ASIDE, APART = (
    2e-3,
    1.5,
    0.1,
)  # where dry friction turns round [m/s]; where waves are told apart, of the place [m]


def split(corners, length):
    """The points (n, 2) along a line through corners, at most ``length`` [m] apart."""
    counts = [int(np.ceil(np.hypot(*np.subtract(b, a)) / length)) for a, b in pairwise(corners)]
    parts = [np.linspace(a, b, n + 1)[:-1] for (a, b), n in zip(pairwise(corners), counts, strict=True)]
    return np.concatenate([*parts, [corners[-1]]])


def outline(section, length):
    """The ends (2, n, 2) of all panels, counter-clockwise around the water, and what each of them is."""
    corner = [(length, DEPTH), (0.0, DEPTH)]
    lines = [("end", split([(length, 0.0), corner[0]], COARSE))]
    if section:
        line = section.wet[::-1] + section.keel
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

    def __init__(self, places, section=None, hinge=HINGE):
        self.section, self.places = section, list(places)
        if section:  # waves before and behind it
            near = max(section.place - ASIDE, 0.5 * (section.place + section.left))
            self.places += [near, near + APART, section.place + ASIDE]
        length = max(LEAVE, max(self.places) + ASIDE)
        count = round(WINDOW / STEP)
        above = 2.0 * np.pi * np.fft.rfftfreq(count, STEP)
        self.rates = above[above < 2.0 * np.pi * HIGHEST] - 1j * FADE / WINDOW
        self.k = np.array([wave_number(w) for w in self.rates])
        (start, end), kinds = outline(section, length)
        middle, size = 0.5 * (start + end), np.hypot(*(end - start).T)
        along = (end - start) / size[:, None]
        normal = np.stack([along[:, 1], -along[:, 0]], axis=1)
        of_q, of_potential = influence(start, along, normal, size, middle)
        flap = np.where(kinds == "flap", -np.maximum(middle[:, 1] - hinge, 0.0) / (DEPTH - hinge), 0.0)
        x, y = (middle - (section.keel if section else 0.0)).T
        modes = np.stack([*normal.T, x * normal[:, 1] - y * normal[:, 0]], axis=1) * (kinds == "hull")[:, None]
        moved, top = np.concatenate([flap[:, None], modes], axis=1), np.flatnonzero(kinds == "top")
        order = top[np.argsort(middle[top, 0])]
        self.loads = np.zeros((len(self.rates), 3, 4), dtype=complex)
        self.surfaces = np.zeros((len(self.rates), len(self.places), 4), dtype=complex)
        for n, (w, k) in enumerate(zip(self.rates, self.k, strict=True)):
            factor = np.where(kinds == "top", w**2 / GRAVITY, np.where(kinds == "end", -1j * k, 0.0))
            potential = np.linalg.solve(of_potential - of_q * factor, of_q @ (1j * w * moved))
            self.loads[n] = (
                -DENSITY * 1j * w * (section.breadth if section else 1.0) * (modes * size[:, None]).T @ potential
            )
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
        section, lever = self.section, self.lever(rig)
        around = lever @ self.loads[:, :, 1:] @ lever.T
        inertia = np.diag([section.mass + section.guides, section.mass, section.mass * rig.gyration**2])
        held = np.diag([rig.stiffness, 0.0, 0.0])
        held[1:, 1:] = DENSITY * GRAVITY * section.stiffness(rig.gravity_centre)
        w, damped = self.rates[:, None, None], np.diag([rig.damping, rig.damping, roll_damping])
        return np.linalg.inv(held + 1j * w * damped - w**2 * inertia - around), self.loads[:, :, 0] @ lever.T

    def lever(self, rig):
        """The matrix (3, 3) that turns loads about the keel into those about the centre of gravity."""
        lever = np.eye(3)
        lever[2, :2] = rig.gravity_centre, -self.section.buoyancy_centre[0]
        return lever

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

    def surface(self, flap, keel):
        """The surface (n, places) [m] of amplitudes of the flap (n,) and of the section about its keel (n, 3)."""
        return np.einsum("npj,nj->np", self.surfaces, np.concatenate([flap[:, None], keel], axis=1))

    def answers(self, stroke):
        """The surface (times, places) [m] that a stroke makes, and loads on the section (times, 3), or its motions."""
        flap, count, section = self.spectrum(stroke), len(stroke), self.section
        still, places = np.zeros((len(self.rates), 3)), len(self.places) - (3 if section else 0)
        if section and section.rig:
            answer, pushed = self.response(section.rig)
            moved = np.einsum("nij,nj->ni", answer, pushed * flap[:, None]) @ self.lever(section.rig)
            return self.series(self.surface(flap, moved)[:, :places], count), self.motions(stroke, section.rig)
        about_gauge = np.array([[1.0, 0.0, GAUGE], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
        loads = self.series(self.loads[:, :, 0] @ about_gauge * flap[:, None], count)
        return self.series(self.surface(flap, still)[:, :places], count), loads

    def drift(self, flap, linear, rig, count):
        """The slow force (times,) [N] across: the momentum that waves lose at the section (Longuet-Higgins 1977)."""
        surface = self.surface(flap, linear @ self.lever(rig))
        near, beside, behind = surface[:, -3:].T
        turn, way = np.exp(-1j * self.k * APART), np.exp(-1j * self.k * (self.section.place - self.places[-3]))
        onward = (beside - near / turn) / (turn - 1.0 / turn)
        waves = np.stack([onward * way, (near - onward) / way, behind / way], axis=1)
        waves[np.abs(self.rates) < 2.0] = 0.0
        sent, back, passed = (np.abs(self.analytic(waves, count)) ** 2).T
        k = self.k[np.argmax(np.abs(flap))].real
        depth = 1.0 + 2.0 * k * DEPTH / np.sinh(2.0 * k * DEPTH)
        return 0.25 * DENSITY * GRAVITY * depth * self.section.breadth * (sent + back - passed)


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
    parser = parser_of(__doc__)
    asked = parser.parse_args()
    try:
        case = read(asked).within()
    except (OSError, ValueError) as wrong:
        parser.error(str(wrong))
    names, times, late = [*case.on_section, *case.probes], case.times, case.late
    surface, on_section = LinearFlume(case.probes.values(), case.section, hinge=asked.hinge).answers(case.stroke)
    found = np.concatenate([on_section, surface] if case.section else [surface], axis=1)
    long = period(times, case.stroke)
    print(f"linear theory, waves of {long:.3f} s; amplitude, measured amplitude, ratio, phase after measured [deg]")
    for name, one, other in zip(names, found.T, case.columns(names).T, strict=True):
        own, true = (swing(times[late], each[late], long) for each in (one, other))
        print(f"{name:10} {abs(own):9.4g}", end="")
        print(
            f" {abs(true):9.4g} {abs(own / true):6.3f} {np.degrees(np.angle(true / own)):6.1f}"
            if np.isfinite(true)
            else ""
        )


if __name__ == "__main__":
    main()
