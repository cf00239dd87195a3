"""Linear theory of the flume by panels, and the section's numbers that are found with it from motions."""

import runpy
import sys

import numpy as np
import pytest

from flume_scripts import FOLDER, names_of


@pytest.fixture(scope="module")
def body():
    """The names of `body.py`, with coarse panels, and a flume of them."""
    names = names_of("body.py")
    theory = names["LinearFlume"].__init__.__globals__
    theory.update(COARSE=0.08, FINE=0.05, HIGHEST=1.2)
    names["flume"] = names["LinearFlume"]([3.0], names["MEASURED"])
    return {**names, "theory": theory}


@pytest.mark.parametrize("turns", [1, -1])
@pytest.mark.parametrize("lean", [0.0, 0.3])
def test_a_trapezium_displaces_what_its_closed_form_says(body, lean, turns):
    """Half as broad as ``a + s y`` at a height y, its middle at ``lean y``; corners either way round, keel at -1."""
    a, s, draught, kg = 0.1, 0.4, 0.2, 0.12
    corners = np.array([[-a, 0.0], [a, 0.0], [a + 0.3 * (s + lean), 0.3], [-a + 0.3 * (lean - s), 0.3]])
    section = body["MEASURED"].__class__((corners - [0.0, 1.0])[::turns], draught, 5.0)
    area = draught * (2.0 * a + s * draught)
    up = draught**2 * (a + 2.0 / 3.0 * s * draught) / area
    assert section.area == pytest.approx(area) and section.mass == pytest.approx(1000.0 * area)
    assert section.buoyancy_centre == pytest.approx([lean * up, up])
    beam, off = 2.0 * (a + s * draught), lean * (draught - up)
    turn = beam**3 / 12.0 + beam * off**2 + area * (up - kg)
    assert section.stiffness(kg) == pytest.approx(np.array([[beam, beam * off], [beam * off, turn]]))
    assert section.corners.min(axis=0) == pytest.approx([5.0 + corners[:, 0].min(), 1.0 - draught])


def test_panels_send_the_waves_of_a_flap(body):
    """Without a section the surface is that of the sum of modes, to what coarse panels can do."""
    theory, times = body["theory"], np.arange(0.0, 20.0, 0.02)
    flume = body["LinearFlume"]([3.0])
    stroke = 0.01 * np.minimum(times / 4.0, 1.0) * np.sin(2.0 * np.pi * times / 1.2)
    found = flume.series(flume.surfaces[:, 0, 0] * flume.spectrum(stroke), len(times))
    exact = names_of("wave_flume.py")["theory"](times, stroke, np.array([3.0]))[:, 0]
    late = times > 12.0
    one, other = (theory["swing"](times[late], each[late], 1.2) for each in (found, exact))
    assert abs(one / other) == pytest.approx(1.0, abs=0.02) and abs(np.angle(one / other)) < 0.15


def test_radiation_keeps_energy(body):
    """What a section loses to waves is symmetric in its motions (Newman 1977), and never negative."""
    flume = body["flume"]
    middle = np.argmin(np.abs(flume.rates - 2.0 * np.pi / 1.0))
    around = flume.loads[middle, :, 1:]
    assert abs(around[0, 2] - around[2, 0]) < 0.03 * abs(around[0, 2])
    heave = np.imag(flume.loads[:, 1, 2] / flume.rates)[np.real(flume.rates) > 3.0]
    assert (heave < 0.0).all()


def test_dry_friction_takes_what_coulomb_says(body):
    """A mass in nothing, at 1 m/s, slows by friction over mass, and then stays."""
    step, mass = 0.02, 50.0
    kick = np.full(600, step / mass)
    force = body["theory"]["rubbed"](np.full(600, 1.0), kick, 10.0)
    speed = 1.0 + np.cumsum(force) * step / mass
    assert speed[200] == pytest.approx(1.0 - 201 * step * 10.0 / mass, abs=0.01) and abs(speed[-1]) < 0.01


def test_the_section_of_a_run_has_the_numbers_that_are_told(monkeypatch, tmp_path, capsys):
    """Centre of gravity, radius of gyration and springs within two bars, which are at most 10 %."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(FOLDER))
    monkeypatch.setattr(sys, "argv", ["body.py"])
    runpy.run_path(str(FOLDER / "body.py"), run_name="__main__")
    lines = capsys.readouterr().out.splitlines()
    rows = [line.split() for line in lines if line.startswith(("centre", "radius", "springs"))]
    assert len(rows) == 3
    for row in rows:
        bar, off = float(row[-2].rstrip("%")), float(row[-1])
        assert bar < 10.0 and off < 2.0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["body_3061_2.png", "body_3102_1.png"]


def test_a_softer_line_pulls_with_half_the_force(capsys):
    """Found by one gradient through the whole simulation; the script itself fails where no stiffness is found."""
    runpy.run_path(str(FOLDER / "mooring.py"), run_name="__main__")
    first, *_, last = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert float(first[0]) == 2000.0 and float(last[-4]) == pytest.approx(0.5, abs=0.025)
