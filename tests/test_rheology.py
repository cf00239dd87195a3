"""Fluids whose viscosity depends on the shear rate: the laws, their derivatives, and what is said of wrong ones."""

import math
import re
import runpy
from pathlib import Path

import numpy as np
import pytest
import warp as wp

import cortado
from bad_scenes import one_sentence
from cortado import InputError, SceneError, Simulation
from cortado.errors import OutOfRangeError
from cortado.forces import OverTime, Rheology
from cortado.sph.stress_forces import LAWS, bingham, carreau, herschel_bulkley, power_law
from scenes import HONEY, aimed, bodies, box, plane

ROOT = Path(__file__).parents[1]
KINDS = {
    "power_law": {"flow_index": 0.6, "least_shear_rate": 0.1},
    "carreau": {"relaxation_time": 0.2, "flow_index": 0.5, "infinite_viscosity": 0.2},
    "bingham": {"yield_stress": 3.0, "regularisation": 0.3},
    "herschel_bulkley": {"yield_stress": 3.0, "flow_index": 0.7, "regularisation": 0.3, "least_shear_rate": 0.1},
}
STEPS = 8
FLUID = box([0.0, 0.0], [0.25, 0.3], velocity=[0.5, 0.2], phase="honey")
ROOM = box([0.0, 0.0], [0.5, 0.5], slip="no")


def thick(rheology=None, solve="automatic", **changes):
    """A block of fluid that moves beside walls without slip."""
    phase = {**HONEY, "viscosity": 1.5, **({} if rheology is None else {"rheology": rheology})}
    forces = {"gravity": [0.3, -9.81], "viscosity": "stress", "viscous_solve": solve}
    return plane(**{"phase": [phase], "fluid": [FLUID], "container": ROOM, "forces": forces, **changes})


def problem(made, precision="float64", **options):
    return aimed(Simulation(made, precision=precision, **options), STEPS)


@pytest.mark.parametrize("shear_rate", [1e-6, 0.03, 2.0, 500.0])
def test_laws_are_the_published_ones(shear_rate):
    g = shear_rate
    assert power_law(g, 2.0, 0.6, 0.1) == pytest.approx(2.0 * math.hypot(g, 0.1) ** -0.4, rel=1e-6)
    wanted = 0.2 + 1.8 * (1.0 + (0.3 * g) ** 2) ** -0.25
    assert carreau(g, 2.0, 0.3, 0.5, 0.2) == pytest.approx(wanted, rel=1e-6)
    yielding = 3.0 * -math.expm1(-0.7 * g) / g
    assert bingham(g, 2.0, 3.0, 0.7) == pytest.approx(2.0 + yielding, rel=1e-5)
    wanted = 2.0 * math.hypot(g, 0.1) ** -0.4 + yielding
    assert herschel_bulkley(g, 2.0, 3.0, 0.7, 0.6, 0.1) == pytest.approx(wanted, rel=1e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_every_number_of_a_law_is_certified(kind):
    """In an implicit solve; derivatives without one are in tests/test_features.py."""
    judged = problem(thick({"kind": kind, **KINDS[kind]}, "implicit"))
    names = [name for name in judged.simulation.parameters() if name.startswith(f"{kind}.")]
    assert sorted(names) == sorted(f"{kind}.{key}" for key in KINDS[kind])
    assert cortado.certify(judged, [*names, "viscosity", "initial_velocities", "initial_positions", "time_step"]).right


def test_a_law_that_is_newton_s_changes_nothing():
    newtonian = Simulation(thick(), precision="float64").run(STEPS).positions[-1]
    for rheology in (
        {"kind": "carreau", "relaxation_time": 0.3, "flow_index": 1.0},
        {"kind": "power_law", "flow_index": 1.0},
        {"kind": "bingham", "yield_stress": 0.0},
    ):
        found = Simulation(thick(rheology), precision="float64").run(STEPS).positions[-1]
        np.testing.assert_allclose(found, newtonian, rtol=0.0, atol=1e-14)


def cross(shear_rate, viscosity, time, index):
    """Of Cross (1965)."""
    return viscosity / (1.0 + (time * shear_rate) ** index)


def test_a_law_of_one_s_own_is_one_function():
    own = Simulation(thick(), precision="float64", forces=[Rheology(LAWS["carreau"], **KINDS["carreau"])])
    named = Simulation(thick({"kind": "carreau", **KINDS["carreau"]}), precision="float64")
    np.testing.assert_array_equal(own.run(STEPS).positions, named.run(STEPS).positions)
    judged = problem(thick(), forces=[Rheology(cross, time=0.4, index=0.8)])
    assert cortado.certify(judged, ["cross.time", "cross.index", "viscosity"]).right


def test_a_law_of_one_s_own_in_two_phases_has_the_viscosity_of_each():
    """The same as a Newtonian fluid whose viscosities are twice as large."""
    phases = [{**HONEY, "viscosity": v, "name": name} for v, name in ((1.0, "honey"), (3.0, "syrup"))]
    bodies = [FLUID, {**FLUID, "lower": [0.25, 0.0], "upper": [0.5, 0.3], "phase": "syrup"}]

    def twice(shear_rate, viscosity):
        return 2.0 * viscosity

    law = Simulation(thick(phase=phases, fluid=bodies), precision="float64", forces=[Rheology(twice)])
    doubled = [{**phase, "viscosity": 2.0 * phase["viscosity"]} for phase in phases]
    plain = Simulation(thick(phase=doubled, fluid=bodies), precision="float64")
    np.testing.assert_allclose(law.run(STEPS).positions[-1], plain.run(STEPS).positions[-1], rtol=0.0, atol=1e-12)


LAW = {"kind": "bingham", "yield_stress": 1.0}


@pytest.mark.parametrize(
    ("rheology", "changes", "words"),
    [
        ({"kind": "jelly"}, {}, r"phase\[0\].rheology"),
        ({"kind": "bingham", "yield_stress": -1.0}, {}, "yield_stress"),
        ({"kind": "carreau", "relaxation_time": 0.1, "flow_index": 0.5, "yield_stress": 1.0}, {}, "yield_stress"),
        (None, {"phase": [{**HONEY, "rheology": LAW}, {**HONEY, "name": "syrup"}]}, "several phases"),
        (LAW, {"forces": {"gravity": [0.0, -9.81], "viscosity": "none"}}, "is 'none', but must be \"stress\""),
    ],
)
def test_what_is_no_law_is_a_sentence(rheology, changes, words):
    with one_sentence(words, SceneError):
        thick(rheology, **changes)


@pytest.mark.parametrize("kind", ["bingham", "herschel_bulkley"])
def test_a_film_that_does_not_yield_creeps_as_slowly_as_is_said(kind):
    """98 Pa at the wall of 150 Pa, thin as it is once it flows: the closed form of `cortado.scene.scene_warnings`."""
    depth, deep, slope = 0.1, 8, 0.1
    spacing, size, sides = depth / deep, math.hypot(1.0, slope), {"periodic": [True, False], "slip": "no"}
    index = {"flow_index": 0.6} if kind == "herschel_bulkley" else {}
    phase = {"rest_density": 1000.0, "viscosity": 0.01, "rheology": {"kind": kind, "yield_stress": 150.0, **index}}
    with pytest.warns(cortado.CortadoWarning, match=r"below 150 Pa, it creeps, at up to 0.0025 m/s: its depth, 0.1 m"):
        made = bodies(
            2,
            [box([0.0, 0.0], [8 * spacing, depth], phase="mud")],
            box([0.0, 0.0], [8 * spacing, 1.5 * depth], **sides),
            spacing,
            phase=[{"name": "mud", **phase}],
            forces={"gravity": [9.81 * slope / size, -9.81 / size], "viscosity": "stress"},
            solver={"kind": "pcisph", "time_step": 0.002},
        )
    end = Simulation(made, precision="float64").run(200)
    heights, speeds = end.positions[-1][:, 1] / depth, end.velocities[-1][:, 0]
    r = 1000.0 * 9.81 * slope / size * depth / 150.0
    left = 1.0 - r * (1.0 - heights)  # of the yield stress, beyond the stress at each height
    wanted = depth / 40.0 * (heights + (left * np.log(left) - (1.0 - r) * math.log(1.0 - r)) / -r)
    inside = heights > 1.0 / deep  # particles at the wall are slower still
    np.testing.assert_allclose(speeds[inside], wanted[inside], rtol=0.02)
    assert (speeds < 1.02 * wanted).all() and speeds.max() < depth / 40.0
    assert end.diagnostics["viscous_iterations"].max() < 200


def turned(viscosity, shear_rate):
    return viscosity


def test_laws_of_one_s_own_that_do_not_fit_are_sentences():
    own, other = Rheology(cross, time=0.4, index=0.8), Rheology(cross, "other", time=0.1, index=0.5)
    pairwise = thick(forces={"gravity": [0.0, 0.0], "viscosity": "pairwise"})
    bingham, words = thick({"kind": "bingham", **KINDS["bingham"]}), r"^Rheology\(.*\) and Rheology\(.*\) both replace"
    steep = {**HONEY, "viscosity": 1e28, "rheology": {"kind": "power_law", "flow_index": 3.0}}
    for make, said in (
        (lambda: Simulation(pairwise, forces=[own]), "viscosity is 'pairwise', but must be 'stress'"),
        (lambda: Rheology(turned), "must have shear_rate, viscosity first"),
        (lambda: Simulation(thick(), forces=[own, other]), words),
        (lambda: Simulation(bingham, forces=[own]), words),
        (
            lambda: Simulation(thick(phase=[steep])),
            r"power_law returns inf Pa s at a shear rate of .* for honey",
        ),
    ):
        with pytest.raises(InputError, match=said):
            make()


def beyond(shear_rate, viscosity, slope):
    return viscosity - slope * shear_rate


def root(shear_rate, viscosity, least):
    return viscosity * wp.sqrt(1.0 - least * shear_rate)


def in_time(shear_rate, viscosity, t, slope):
    return viscosity - slope


@pytest.mark.parametrize(
    ("law", "said"),
    [
        (lambda: Rheology(beyond, slope=1e-4), r"beyond returns -\d.* Pa s at a shear rate of 1\.\d*e\+04 1/s"),
        (lambda: Rheology(root, least=1e-5), "root returns -?nan Pa s at a shear rate of 1"),
        (lambda: Rheology(in_time, slope=OverTime([0.0, 2.0], [0.0, 2.0])), "in_time returns -0.5 Pa s"),
    ],
)
def test_a_law_that_is_negative_or_not_finite_is_refused(law, said):
    with pytest.raises(InputError, match=said):
        Simulation(thick(), precision="float64", forces=[law()])


def swirled(shear_rate, viscosity, t, swirl, slope):
    return viscosity + swirl[0] + swirl[1] - slope * t


BENT = {"swirl": [0.1, 0.2], "slope": OverTime([0.0, 1.0], [0.0, 0.0])}


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"beyond.slope": 1e-4}, r"beyond returns -\d.* at a shear rate of 1\.\d*e\+04 1/s for h"),
        ({"viscosity": 1e-9, "beyond.slope": 1e-9}, r"beyond returns -\d.* for honey with the viscosity 1e-09 Pa s"),
        ({"swirled.swirl": [-2.0, 0.0]}, "swirled returns -0.5 Pa s"),
        ({"swirled.slope": np.array([0.0] * 4 + [1e3] * 4)}, r"swirled returns -\d"),
    ],
)
def test_values_that_come_later_make_a_law_that_is_tried(values, said):
    """Of a run, and in a search, whose trial steps with them are refused; those of a batch say which scene."""
    name = next(one for one in values if "." in one)
    made = Rheology(beyond, slope=0.0) if name.startswith("beyond") else Rheology(swirled, **BENT)
    judged = problem(thick(), forces=[made])
    assert np.isfinite(judged.value({name: judged.simulation.parameters()[name]}))
    with pytest.raises(OutOfRangeError, match=said):
        judged.simulation.run(STEPS, values)
    with pytest.raises(OutOfRangeError, match=said):
        judged.value(values)


def test_a_search_refuses_a_law_that_is_none_and_goes_on():
    judged = problem(thick(), forces=[Rheology(swirled, swirl=[0.0, 0.0], slope=0.0)])
    found = cortado.optimise(judged, {"swirled.swirl": [0.0, 0.0]}, "adam", 3, learning_rate=2.0)
    assert found.refused and np.isfinite(found.loss)


def test_the_law_of_the_page_runs_as_printed(tmp_path, monkeypatch):
    """From a file, as Warp wants the text of functions, with what stands on the page before it."""
    page = (ROOT / "docs/viscosity.md").read_text(encoding="utf-8")
    blocks = re.findall(r"^```(?:py|python)\n(.*?)^```$", page, re.DOTALL | re.MULTILINE)
    assert len(blocks) == 2
    program, parts = tmp_path / "page.py", [blocks[0].partition("carreau = ")[0], blocks[1], "thinning.run(3)"]
    program.write_text("\n".join(parts), encoding="utf-8")
    monkeypatch.chdir(ROOT)
    runpy.run_path(str(program))
