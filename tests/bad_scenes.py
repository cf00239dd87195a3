"""A good scene, and bad ones: (name, what to replace in the good one, by what, the field that the sentence names)."""

from contextlib import contextmanager

import pytest

from cortado import InputError

GOOD_SCENE = """\
name = "two blocks"
dimension = 3

[discretisation]
spacing = 0.05
support = 2.0
kernel = "cubic_spline"

[[phase]]
name = "water"
rest_density = 1000.0
viscosity = 0.05
colour = [0.1, 0.3, 0.8]

[[fluid]]
shape = "box"
lower = [0.0, 0.0, 0.0]
upper = [0.25, 0.25, 0.25]
velocity = [0.0, 0.0, 0.0]
phase = "water"

[[fluid]]
shape = "sphere"
centre = [0.2, 0.45, 0.12]
radius = 0.1
phase = "water"

[container]
shape = "box"
lower = [0.0, 0.0, 0.0]
upper = [0.4, 0.6, 0.25]
periodic = [true, false, false]
slip = "no"

[forces]
gravity = [0.0, -9.81, 0.0]
viscosity = "pairwise"
pressure = true

[solver]
kind = "pcisph"
time_step = 0.0021
minimum_iterations = 5
maximum_iterations = 5
density_tolerance = 0.01
"""


def plane(**changes) -> dict:
    """The least that a scene in 2-D needs."""
    data = {
        "dimension": 2,
        "discretisation": {"spacing": 0.1},
        "phase": [{"name": "water", "rest_density": 1000, "viscosity": 0.001}],
        "fluid": [{"shape": "box", "lower": [0, 0], "upper": [1, 0.5], "phase": "water"}],
        "solver": {"kind": "pcisph", "time_step": 1e-3},
    }
    return data | changes


def assert_one_sentence(text: str) -> None:
    assert text.splitlines() == [text] and text[-1] in ".?" and len(text) < 500
    assert "\x00" not in text and ".." not in text.replace("...", "")


def assert_refused(result: tuple[int, str, str], *words: str) -> None:
    """Exit code 2, and one sentence on stderr, which holds these words."""
    code, out, err = result
    assert (code, out) == (2, ""), err
    assert_one_sentence(err.removesuffix("\n"))
    assert all(word in err for word in words), err


@contextmanager
def one_sentence(words: str | None = None, error: type[Exception] = InputError):
    """What is refused within is told in one sentence, in which the expression ``words``, if any, is found."""
    with pytest.raises(error, match=words) as caught:
        yield caught
    assert_one_sentence(str(caught.value))


_SPHERE = 'shape = "sphere"\ncentre = [0.2, 0.45, 0.12]\nradius = 0.1'
_UPPER = "upper = [0.25, 0.25, 0.25]"
_CONTAINER = GOOD_SCENE[GOOD_SCENE.index("[container]") : GOOD_SCENE.index("[forces]")]
_FLUIDS = GOOD_SCENE[GOOD_SCENE.index("[[fluid]]") : GOOD_SCENE.index("[container]")]
_PHASE = GOOD_SCENE[GOOD_SCENE.index("[[phase]]") : GOOD_SCENE.index("[[fluid]]")]


def _drop(x: float) -> str:
    return f'[[fluid]]\nshape = "sphere"\ncentre = [{x}, 0.2, 0.12]\nradius = 0.03\nphase = "water"\n'


def _with(table: str, old: str, new: str) -> tuple[str, str]:
    """What to replace in the good scene, and by what, so that it gets a good table in which the old is replaced."""
    assert old in table
    return "[solver]", table.replace(old, new, 1) + "[solver]"


EMITTER = """\
[[emitter]]
phase = "water"
outlet = [0.2, 0.6, 0.12]
direction = [0.0, -2.0, 0.0]
radius = 0.07
length = 0.2
flow_rate = 1e-3
"""
OIL = _PHASE.replace("water", "oil")
MIXTURE = (
    OIL
    + """\
[mixture]
free_energy = "miscible"
strength = 2.0
mobility = 1e-5
mobility_form = "constant"
interface_width = 0.1
"""
)
RENDER = """\
[render]
view = "volume"
resolution = [32, 16]
background = [0.0, 0.5, 1.0]
extinction = 3.0
position = [0.2, 0.3, 2.0]
look_at = [0.2, 0.3, 0.1]
field_of_view = 30.0
"""

BAD_SCENES = [
    ("broken syntax", "dimension = 3", "dimension = = 3", "line 2"),
    ("key twice", "dimension = 3", "dimension = 3\ndimension = 3", "line 3"),
    ("nested without end", "dimension = 3", "dimension = " + 5000 * "[", "TOML"),
    ("negative spacing", "spacing = 0.05", "spacing = -0.05", "discretisation.spacing"),
    ("vanishing spacing", "spacing = 0.05", "spacing = 1e-300", "discretisation.spacing"),
    ("spacing that is text", "spacing = 0.05", 'spacing = "0.05"', "discretisation.spacing"),
    ("spacing that is a date", "spacing = 0.05", "spacing = 2020-01-01", "discretisation.spacing"),
    ("no spacing", "spacing = 0.05\n", "", "discretisation.spacing"),
    ("spacing wider than the fluid", "spacing = 0.05", "spacing = 0.3", "fluid[0]"),
    ("short support", "support = 2.0", "support = 1.1", "discretisation.support"),
    ("unknown kernel", '"cubic_spline"', '"gaussian"', "discretisation.kernel"),
    ("no discretisation", 'spacing = 0.05\nsupport = 2.0\nkernel = "cubic_spline"', "", "discretisation.spacing"),
    ("four dimensions", "dimension = 3", "dimension = 4", "dimension"),
    ("no dimension", "dimension = 3", "", "dimension"),
    ("plane with vectors of space", "dimension = 3", "dimension = 2", "fluid[0]"),
    ("empty name", '"two blocks"', '""', "name"),
    ("density that is true", "1000.0", "true", "phase[0].rest_density"),
    ("huge density", "1000.0", "1" + 400 * "0", "phase[0].rest_density"),
    ("viscosity that is no number", "viscosity = 0.05", "viscosity = nan", "phase[0].viscosity"),
    ("colour out of range", "[0.1, 0.3, 0.8]", "[0.1, 1.3, 0.8]", "phase[0].colour[1]"),
    ("phases of one name", _PHASE, _PHASE + _PHASE, "phase[1].name"),
    ("no phase", _PHASE, "", "phase"),
    ("phase that is one table", "[[phase]]", "[phase]", "phase"),
    ("unknown phase", 'phase = "water"', 'phase = "oil"', "fluid[0].phase"),
    ("fluid without phase", 'radius = 0.1\nphase = "water"', "radius = 0.1", "fluid[1].phase"),
    ("no fluid", _FLUIDS, "", "fluid"),
    ("fluid that is text", _FLUIDS + _CONTAINER, _CONTAINER + "[[fluid]]\n", "fluid[0].shape"),
    ("shape that is a list", 'shape = "sphere"', 'shape = ["sphere"]', "fluid[1].shape"),
    ("upper below lower", _UPPER, "upper = [0.25, -0.25, 0.25]", "fluid[0].upper"),
    ("upper of two", _UPPER, "upper = [0.25, 0.25]", "fluid[0].upper"),
    ("upper of none", _UPPER, "upper = []", "fluid[0].upper"),
    ("upper with text", _UPPER, 'upper = [0.25, "0.25", 0.25]', "fluid[0].upper[1]"),
    ("thin box", _UPPER, "upper = [0.25, 0.25, 0.04]", "fluid[0]"),
    ("box outside", _UPPER, "upper = [0.25, 0.25, 0.35]", "fluid[0]"),
    ("far away", _UPPER, "upper = [1e20, 0.25, 0.25]", "discretisation.spacing"),
    ("sphere outside", "0.45, 0.12", "0.55, 0.12", "fluid[1]"),
    ("overlapping sphere", "0.45, 0.12", "0.30, 0.12", "fluid[1]"),
    ("overlapping across the period", _FLUIDS, _drop(0.01) + _drop(0.39), "fluid[1]"),
    ("small sphere", "radius = 0.1", "radius = 0.02", "fluid[1]"),
    ("missing points", _SPHERE, 'shape = "points"\nfile = "absent.npy"', "fluid[1].file"),
    ("points in text", _SPHERE, 'shape = "points"\nfile = "scene.toml"', "fluid[1].file"),
    ("container upside down", "upper = [0.4, 0.6, 0.25]", "upper = [0.4, -0.6, 0.25]", "container.upper"),
    ("period that is a number", "[true, false, false]", "[1, 0, 0]", "container.periodic[0]"),
    ("short period", "support = 2.0", "support = 4.0", "container.periodic[0]"),
    ("period of nothing", _CONTAINER, '[container]\nshape = "none"\nperiodic = [true, false, false]\n', "periodic"),
    ("container without shape",
     'shape = "box"\nlower = [0.0, 0.0, 0.0]\nupper = [0.4', "upper = [0.4", "container.shape"),
    ("cup too small", _CONTAINER,
     '[container]\nshape = "cylinder"\nbase = [0, 0, 0]\nradius = 0.2\nheight = 1\n', "fluid[0]"),
    ("gravity of two", "[0.0, -9.81, 0.0]", "[0.0, -9.81]", "forces.gravity"),
    ("unknown solver", '"pcisph"', '"iisph"', "solver.kind"),
    ("misspelt key", "time_step = 0.0021", "timestep = 0.0021", "solver.timestep"),
    ("fewest above most", "minimum_iterations = 5", "minimum_iterations = 6", "solver.minimum_iterations"),
    ("mixture of one phase", *_with(MIXTURE, OIL, ""), "mixture"),
    ("one table of emitters", *_with(EMITTER, "[[emitter]]", "[emitter]"), "emitter"),
    ("emitter of unknown phase", *_with(EMITTER, "water", "oil"), "emitter[0].phase"),
    ("outlet outside", *_with(EMITTER, "[0.2, 0.6, 0.12]", "[0.2, 0.61, 0.12]"), "emitter[0].outlet"),
    ("outlet in fluid", *_with(EMITTER, "[0.2, 0.6, 0.12]", "[0.2, 0.45, 0.12]"), "emitter[0]"),
    ("column in fluid", *_with(EMITTER, "outlet = [0.2, 0.6", "outlet = [0.2, 0.35"), "emitter[0]"),
    ("no direction", *_with(EMITTER, "-2.0", "-0.0"), "emitter[0].direction"),
    ("out of the container", *_with(EMITTER, "-2.0", "2.0"), "emitter[0].direction"),
    ("column across the period", *_with(
        EMITTER, "[0.2, 0.6, 0.12]\ndirection = [0.0, -2.0, 0.0]", "[0.1, 0.33, 0.12]\ndirection = [1, 0, 0]"),
     "emitter[0]"),
    ("slanted nozzle at the wall", *_with(EMITTER, "[0.0, -2.0, 0.0]", "[1.0, -1.0, 0.0]"), "emitter[0].radius"),
    ("nozzle that does not fit", *_with(EMITTER, "radius = 0.07", "radius = 0.18"), "emitter[0].radius"),
    ("column of no layer", *_with(EMITTER, "length = 0.2", "length = 0.02"), "emitter[0].length"),
    ("column of great length", *_with(EMITTER, "length = 0.2", "length = 1e50"), "discretisation.spacing"),
    ("camera above", *_with(RENDER, '"volume"', '"top"'), "render.position"),
    ("camera of the default view", *_with(RENDER, 'view = "volume"', ""), "render.position"),
    ("plane in space", *_with("[render]\nview = 1\n", "1", '"plane"'), "render.view"),
    ("no place for the camera", *_with(RENDER, "position = [0.2, 0.3, 2.0]", ""), "render.position"),
    ("camera that looks at itself", *_with(RENDER, "[0.2, 0.3, 0.1]", "[0.2, 0.3, 2.0]"), "render.look_at"),
    ("camera in the plane", *_with(RENDER, "[0.2, 0.3, 2.0]", "[0.2, 0.3]"), "render.position"),
    ("few pixels", *_with(RENDER, "[32, 16]", "[32, 7]"), "render.resolution[1]"),
    ("key in two lines", 'name = "two', '"a\\nb" = 1\nname = "two', "'a\\nb'"),
    ("unknown table", "[solver]", "[viewer]\nwidth = 3\n[solver]", "viewer"),
]  # fmt: skip
