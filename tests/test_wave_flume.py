"""The numerical flume of `examples/wave_flume`: its theory, its fit, and a short run beside what was measured."""

import runpy
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from cortado.pictures.image_files import read_picture
from flume_scripts import FOLDER, names_of

FLUME = names_of("wave_flume.py")
OWN = ["--hull", "hull.csv", "--draught", "0.15", "--at", "1", "--centre", "0.12", "--gyration", "0.14"]


@pytest.mark.parametrize(("period", "hinge"), [(0.897, 0.1), (1.158, 0.0)])
def test_a_steady_flap_makes_the_waves_of_its_transfer_function(period, hinge):
    """A flap with a hinge at the floor or above it (Dean and Dalrymple 1991, section 6.3), far from it."""
    omega, depth = 2.0 * np.pi / period, FLUME["DEPTH"]
    k = omega**2 / 9.81
    for _ in range(100):
        k = omega**2 / (9.81 * np.tanh(k * depth))
    arm, kd = depth - hinge, k * depth
    lever = np.sinh(kd) + (np.cosh(k * hinge) - np.cosh(kd)) / (k * arm)
    wanted = 2.0 * np.sinh(kd) / (0.5 * np.sinh(2.0 * kd) + kd) * lever
    times = np.arange(0.0, 16.0, 0.02)
    stroke = 0.01 * np.minimum(times / 4.0, 1.0) * np.sin(omega * times)
    found, late = FLUME["theory"](times, stroke, np.array([3.0]), hinge=hinge)[:, 0], times > 11.0
    assert abs(FLUME["swing"](times[late], found[late], period)) / 0.01 == pytest.approx(wanted, rel=0.01)
    assert FLUME["period"](times, stroke) == pytest.approx(period, abs=0.005)


def test_waves_come_to_the_probes_as_they_were_measured(monkeypatch, tmp_path, capsys):
    """With 12 particles in the depth; a flap that moved the other way would be 180 degrees off."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(FOLDER))
    monkeypatch.setattr(sys, "argv", ["wave_flume.py", "--deep", "12", "--begin", "9", "--end", "13"])
    runpy.run_path(str(FOLDER / "wave_flume.py"), run_name="__main__")
    left_out, _, _, *rows = [line.split() for line in capsys.readouterr().out.splitlines()[:7]]
    assert left_out[-2:] == ["8.5", "m"]
    places, ratios, phases = np.array([[float(row[n]) for n in (0, 4, 5)] for row in rows]).T
    assert places.tolist() == [3.0, 4.95, 5.2, 5.5]
    assert (np.abs(ratios - 0.95) < 0.15).all() and (np.abs(phases) < 25.0).all()
    assert np.ptp(read_picture(tmp_path / "wave_flume.png")) > 0.5


@pytest.fixture
def own_case(monkeypatch, tmp_path):
    """A record of a flap alone, with an offset, and a hull, in the current folder."""
    monkeypatch.chdir(tmp_path)
    times = np.arange(0.0, 10.0, 0.04)
    rows = [f"{one + 1.0},{0.001 + 0.01 * np.sin(6.0 * one)}" for one in times]
    (tmp_path / "flap.csv").write_text("\n".join(["time_s,wavemaker_m", *rows]))
    (tmp_path / "hull.csv").write_text("x_m,y_m\n-0.2,0.3\n-0.1,0\n0.1,0\n0.2,0.3\n")


def test_a_flap_and_a_hull_of_ones_own_need_no_measurements(monkeypatch, own_case, capsys):
    """A few steps with coarse panels; the record begins at neither 0 m nor 0 s, and one probe is on the beach."""
    monkeypatch.setitem(FLUME["read"].__globals__, "SHORTEST", 0.05)
    monkeypatch.setitem(FLUME["LinearFlume"].__init__.__globals__, "COARSE", 0.1)
    monkeypatch.setitem(FLUME["LinearFlume"].__init__.__globals__, "HIGHEST", 1.2)
    few = ["--deep", "10", "--long", "4", "--begin", "0", "--end", "0.05", "--probes", "0.5", "3", "1.6"]
    monkeypatch.setattr(sys, "argv", ["wave_flume.py", "flap.csv", *OWN, *few])
    FLUME["main"]()
    said = capsys.readouterr().out
    assert "1 mm and 1 s" in said and "probes left out" in said and "3 m\n" in said
    assert "37.50 kg for each metre" in said and "correlation" not in said
    assert " ".join(line.split()[0] for line in said.splitlines()[-6:-1]) == "0.50 1.60 sway_m: heave_m: roll_rad:"
    assert "nan" not in said and np.ptp(read_picture("wave_flume.png")) > 0.5


def test_a_flap_makes_waves_meet_where_they_shall():
    """In linear theory, whose derivative it is, one round is enough: the crest is as high as was asked, and in time."""
    backward = names_of("backward.py")
    names = backward["found"].__globals__
    names["simulated"] = lambda times, stroke, places, asked: stroke
    names["surface"] = lambda stroke, times, places: FLUME["theory"](times, stroke, np.array(places))
    times = np.arange(0.0, 17.01, 0.02)
    stroke, here = backward["found"](times, backward["focused"](times), SimpleNamespace(rounds=1), [8.0])
    before = times < 14.0
    assert here[700, 0] == pytest.approx(0.036, rel=0.05) and here[:, 0].argmax() == 700
    assert here[before, 1].max() < 0.02 and 0.005 < np.abs(stroke).max() < 0.05
