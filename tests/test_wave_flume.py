"""The numerical flume of `examples/wave_flume`: its theory, its fit, and a short run beside what was measured."""

import runpy
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from cortado.pictures.image_files import read_picture

EXAMPLE = Path(__file__).parents[1] / "examples" / "wave_flume" / "wave_flume.py"
FLUME = runpy.run_path(str(EXAMPLE))


@pytest.mark.parametrize("period", [0.897, 1.158, 1.5])
def test_a_steady_flap_makes_the_waves_of_its_transfer_function(period):
    """A flap with a hinge above the floor (Dean and Dalrymple 1991, section 6.3), far from it."""
    omega, depth, hinge = 2.0 * np.pi / period, FLUME["DEPTH"], FLUME["HINGE"]
    k = omega**2 / 9.81
    for _ in range(100):
        k = omega**2 / (9.81 * np.tanh(k * depth))
    arm, kd = depth - hinge, k * depth
    lever = np.sinh(kd) + (np.cosh(k * hinge) - np.cosh(kd)) / (k * arm)
    wanted = 2.0 * np.sinh(kd) / (0.5 * np.sinh(2.0 * kd) + kd) * lever
    times = np.arange(0.0, 16.0, 0.01)
    stroke = 0.01 * np.minimum(times / 4.0, 1.0) * np.sin(omega * times)
    found, late = FLUME["theory"](times, stroke, np.array([3.0]))[:, 0], times > 11.0
    assert abs(FLUME["swing"](times[late], found[late], period)) / 0.01 == pytest.approx(wanted, rel=0.01)
    assert FLUME["period"](times, stroke) == pytest.approx(period, abs=0.005)


def test_the_bar_of_a_gain_holds_what_a_model_lacks():
    """Where an error lasts for many samples, the bar of noise is far too short, and that of blocks holds it."""
    times, missed, random = np.arange(0.0, 9.0, 0.02), [], np.random.default_rng(1)
    found = np.sin(2.0 * np.pi * times / 1.1)[:, None] * np.ones(4)
    for _ in range(100):
        slow = 0.1 * np.convolve(random.normal(size=len(times) + 49), np.hanning(50) / 5.0, mode="valid")
        factor, noise, bar = FLUME["gain"](1.1 * found + slow[:, None], found, 55, draws=100)
        missed.append([abs(factor - 1.1) > noise, abs(factor - 1.1) > bar])
    of_noise, of_blocks = np.mean(missed, axis=0)
    assert of_noise > 0.5 and of_blocks < 0.2


def test_waves_come_to_the_probes_as_they_were_measured(monkeypatch, tmp_path, capsys):
    """With 12 particles in the depth; a flap that moved the other way would be 180 degrees off."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [str(EXAMPLE), "--deep", "12", "--begin", "9", "--end", "13"])
    runpy.run_path(str(EXAMPLE), run_name="__main__")
    rows = [line.split() for line in capsys.readouterr().out.splitlines()[2:6]]
    places, ratios, phases = np.array([[float(row[n]) for n in (0, 4, 5)] for row in rows]).T
    assert places.tolist() == [3.0, 4.95, 5.2, 5.5]
    assert (np.abs(ratios - 0.95) < 0.15).all() and (np.abs(phases) < 25.0).all()
    assert np.ptp(read_picture(tmp_path / "wave_flume.png")) > 0.5


def test_a_flap_makes_waves_meet_where_they_shall(monkeypatch):
    """In linear theory, whose derivative it is, one round is enough: the crest is as high as was asked, and in time."""
    monkeypatch.syspath_prepend(str(EXAMPLE.parent))
    backward = runpy.run_path(str(EXAMPLE.with_name("backward.py")))
    names = backward["found"].__globals__
    names["simulated"] = lambda times, stroke, places, asked: stroke
    names["surface"] = lambda stroke, times, places: FLUME["theory"](times, stroke, np.array(places))
    times = np.arange(0.0, 17.01, 0.02)
    stroke, here = backward["found"](times, backward["focused"](times), SimpleNamespace(rounds=1), [8.0])
    before = times < 14.0
    assert here[700, 0] == pytest.approx(0.036, rel=0.05) and here[:, 0].argmax() == 700
    assert here[before, 1].max() < 0.02 and 0.005 < np.abs(stroke).max() < 0.05
