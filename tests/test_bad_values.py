"""Values of a wrong type, given to whatever a user may call: a sentence each, and never a bare error of Python's."""

import importlib
import inspect
from collections.abc import Iterable
from contextlib import suppress
from functools import cache
from itertools import product
from pathlib import Path
from tempfile import mkdtemp
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

import cortado
from bad_scenes import plane
from cortado import gradients, losses, optimisers
from cortado.calls import told
from cortado.errors import CortadoError, InputError
from cortado.optimisation.transforms import Affine, Logarithm, Softmax, TimeInterpolation, Transformed

WRONG = {"nothing": None, "a number": 3, "a truth": True, "no text": "", "below 0": -1, "a fraction": 2.5, "a list": []}
WRONG |= {"a table": {}, "an object": object(), "a folder": mkdtemp(), "no number": float("nan"), "bytes": b"x"}
WRONG |= {"an array": np.zeros(3), "a matrix": np.zeros((2, 2)), "a table of a truth": {True: 1}, "a letter": "x"}
WRONG |= {"a table of nothing": {"gravity": None}, "a path": Path(mkdtemp()), "a large number": 10**12}
WRONG |= {"no finite number": float("inf"), "a complex number": 1j}


SMALL = {"width": 64, "height": 64, "quality": "quick"}


@cache
def at():
    """What functions are called with, when all is well."""
    made = SimpleNamespace(scene=cortado.Scene(**plane(picture=SMALL)), loss=losses.CentreOfMass([0.0, 0.0]))
    made.start = {"gravity": [0.0, -9.0]}
    made.simulation = cortado.Simulation(made.scene, precision="float64")
    made.problem = cortado.Problem(made.simulation, 2, made.loss)
    made.trajectory, made.renderer = made.simulation.run(2), made.simulation.renderer(resolution=(10, 8))
    made.image = made.renderer.render(made.trajectory[0])
    return made


@pytest.mark.parametrize(
    "call",
    [
        lambda at, one: cortado.Simulation(at.scene, batch=one),
        lambda at, one: at.simulation.run(one),
        lambda at, one: at.simulation.run(1, record_every=one),
        lambda at, one: cortado.Problem(at.simulation, one, at.loss),
        lambda at, one: cortado.Problem(at.simulation, 2, at.loss, memory_budget=one),
        lambda at, one: cortado.optimise(at.problem, at.start, "adam", iterations=one, learning_rate=0.1),
        lambda at, one: cortado.optimise(at.problem, at.start, "adam", iterations=1, learning_rate=one),
        lambda at, one: cortado.certify(at.problem, ["gravity"], seed=one),
        lambda at, one: cortado.certify(at.problem, ["gravity"], perturbation=one),
        lambda at, one: cortado.image_losses.Pyramid(one),
        lambda at, one: optimisers.LBFGS(memory=one),
        lambda at, one: gradients.EnsembleMean(samples=4, seed=one),
        lambda at, one: cortado.pictures.heart(8, size=one),
    ],
)
def test_a_truth_value_is_no_number(call):
    with pytest.raises(InputError):
        call(at(), True)


OBJECTS = [None, 3, True, {}, object(), int, "x"]


@pytest.mark.parametrize(
    ("call", "wrong"),
    [
        (lambda at, one: losses.Image(one, at.image), OBJECTS),
        (lambda at, one: losses.Recorded(one), OBJECTS),
        (lambda at, one: Transformed(one, {"viscosity": Logarithm()}), OBJECTS),
        (lambda at, one: Transformed(at.problem, one), [None, 3, True, "", [], {"gravity": None}]),
        (lambda at, one: at.problem.states(at.start, one), [None, 3, "x", True, {True: 1}, {"gravity": None}]),
        (lambda at, one: at.problem.states(at.start, one), [[3], [-1], [1.5], [True], ["1"], [None], [1, 10**12]]),
        (lambda at, one: losses.Frames({one: at.loss}), [True, False, "1", None, 1.5]),
        (lambda at, one: Logarithm().coordinate(one), [None, True, float("nan"), 1j, -1]),
        (lambda at, one: cortado.optimise(at.problem, at.start, resume=one), [None, 3, "", np.zeros(3)]),
    ],
)
def test_what_cannot_be_used_is_refused(call, wrong):
    for one in wrong:
        with pytest.raises(InputError, match="must"):
            call(at(), one)


def test_light_of_a_target_is_not_negative():
    target = at().image
    with pytest.raises(InputError, match=r"target has a value of -0.25, but must be linear light from 0 to 1"):
        losses.Image(at().renderer, np.where(target == target.max(), -0.25, target))


def test_coordinates_of_a_wrong_type_work_or_are_a_sentence():
    transformed = Transformed(at().problem, {"viscosity": Logarithm()})
    calls = [transformed.value, transformed.estimate, transformed.parameters, transformed.coordinate]
    for one in (Logarithm(), Softmax(), TimeInterpolation(4, 2), Affine(np.zeros(2), np.ones((2, 3)))):
        calls += [one.parameter, one.coordinate]
    for call, wrong in product(calls, WRONG.values()):
        with suppress(CortadoError):
            call(wrong)


@pytest.mark.parametrize("name", ["mobility", "interface_width"])
def test_a_single_phase_has_no_parameters_of_a_mixture(name):
    with pytest.raises(InputError, match=f"{name} is given, but must be left out, as the scene has only one phase"):
        at().problem.value_and_gradient({name: 1e-6})


def test_guided_is_named_where_it_is_given_a_batch():
    problem = cortado.Problem(cortado.Simulation(cortado.Scene(**plane()), batch=2), 1, at().loss)
    with pytest.raises(InputError, match=r"^Guided is given a problem with a batch"):
        problem.estimate({"gravity": np.zeros((2, 1, 2))}, gradients.Guided())


MODULES = [name for name in cortado.__all__ if isinstance(getattr(cortado, name), ModuleType)]
PUBLIC = ["cortado", *(f"cortado.{name}" for name in [*MODULES, "environments", "jax"])]
ODD = ("nothing", "a fraction", "a letter", "an object")
FEW = {"Ensemble.around", "Ensemble.evaluated", "EnsembleMean.combined", "Trajectory.picture", "Trajectory.to_xarray"}
FEW |= {"certify"}
"""What gets the odd values alone, as parts of Cortado call it with what was looked at, or as it takes seconds."""


@cache
def by_name():
    """Good arguments, by the names that functions and classes have for them."""
    made = at()
    found = vars(made) | {"parameters": made.start, "directions": made.start, "points": [made.start], "steps": 2}
    found |= {"text": made.scene.to_json(), "path": "run.vtkhdf", "target": made.image, "items": [1], "function": str}
    found |= {"u": {"viscosity": np.log(0.05)}, "coordinates": {"viscosity": Logarithm()}, "losses": {1: made.loss}}
    found |= {"base": np.zeros(2), "matrix": np.ones((2, 3)), "knots": 2, "parameter": np.ones(2), "learning_rate": 0.1}
    found |= {"direction": [0.0, 1.0], "levels": 2, "resolution": (10, 8), "observe": lambda step, dot: None}
    found |= {"lower": (0.0, 0.0), "upper": (1.0, 1.0), "spacing": 0.1, "up_axis": 2, "iterations": 1}
    found |= {"sensor": cortado.sensors.WaveGauge([0.1, 0.0]), "dimension": 2, "position": [0.1, 0.1]}
    found |= {"times": 0.001 * np.arange(1, 5), "values": np.zeros(4), "normal": [1.0, 0.0], "noise": 0.1}
    found |= {"frames": np.zeros((4, 8, 10, 3)), "time_step": 0.0021, "task": "Carry"}
    return found | {"positions": made.trajectory[-1].positions}


def odd_calls(function):
    """Of a function or a class: without arguments, and with each argument, and all that are needed, of another kind."""
    takes = inspect.signature(function).parameters
    named = [name for name, one in takes.items() if one.kind in (one.POSITIONAL_OR_KEYWORD, one.KEYWORD_ONLY)]
    needed = [name for name in named if takes[name].default is inspect.Parameter.empty]
    first = sum(one.kind is one.POSITIONAL_ONLY for one in takes.values())
    good = {name: by_name().get(name) for name in needed}
    yield "no arguments", (), {}
    few = function.__qualname__ in FEW or "environments" in function.__module__
    for words, odd in {words: WRONG[words] for words in (ODD if few else WRONG)}.items():
        yield f"all are {words}", [odd] * first, dict.fromkeys(needed, odd)
        yield from ((f"{name} is {words}", [odd] * first, {**good, name: odd}) for name in named)


def objects(kind):
    """One of a class, where good arguments that have its names make one."""
    needed = [n for n, one in inspect.signature(kind).parameters.items() if one.default is one.empty]
    made = [one for one in by_name().values() if type(one) is kind]
    if not made and by_name().keys() >= set(needed):
        with suppress(CortadoError):
            made = [kind(**{name: by_name()[name] for name in needed})]
    names = [name for name in dir(kind) if not name.startswith("_") and name not in ("film", "run")] if made else []
    found = [getattr(made[0], name) for name in names if callable(getattr(kind, name))]
    return [one for one in found if str(getattr(one, "__module__", "")).startswith("cortado")]


@pytest.mark.filterwarnings("ignore::cortado.errors.CortadoWarning", "ignore::RuntimeWarning")
@pytest.mark.parametrize("module", PUBLIC)
def test_whatever_is_public_works_or_says_what_is_wrong(module, tmp_path, monkeypatch):
    """Functions, classes and methods of these: called with too little, and with arguments of another kind."""
    monkeypatch.chdir(tmp_path)
    public = importlib.import_module(module)
    found = [getattr(public, name) for name in public.__all__ if callable(getattr(public, name))]
    made = [one for one in found if not (inspect.isabstract(one) or getattr(one, "_is_protocol", False))]
    made = [one for one in made if not (inspect.isclass(one) and issubclass(one, BaseException))]
    methods = [method for one in made if inspect.isclass(one) for method in objects(one)]
    for function in [*made, *methods]:
        for words, arguments, named in odd_calls(function):
            try:
                function(*arguments, **named)
            except CortadoError as error:
                assert len(str(error)) > 10 and "\n" not in str(error), (function, words)
            except Exception as error:
                pytest.fail(f"{function.__qualname__}, where {words}: {type(error).__name__}: {error}")


def test_the_first_argument_of_another_type_is_named_and_a_mistake_of_ones_own_is_not_hidden():
    arrays = np.zeros(1), np.zeros(1), np.zeros((1, 2, 2)), [[[0.0, 0.0]]]
    with pytest.raises(InputError, match=r"^velocities is \[\[\[0.0, 0.0\]\]\], but must be an array\.$"):
        cortado.Trajectory(*arrays, {})
    with pytest.raises(
        InputError, match=r"^Adam is given no learning_rate, but must be called as Adam\(learning_rate,"
    ):
        optimisers.Adam()
    with pytest.raises(
        InputError, match=r"^on_result takes the arguments '\(\)', but must take 2: the number of a point, "
    ):
        cortado.evaluate(by_name()["problem"], [{}], on_result=lambda: None)

    def fails(number, estimate):
        raise ValueError("of their own")

    with pytest.raises(ValueError, match="of their own"):
        cortado.evaluate(by_name()["problem"], [{}], on_result=fails)

    @told
    def takes_pairs(pairs: Iterable[tuple[str, float]]):
        raise ValueError("of its own")

    with pytest.raises(ValueError, match="of its own"):
        takes_pairs([("density", 1.0)])
    for pair in [("density", "high"), ("density", 1.0, 2.0)]:
        with pytest.raises(InputError, match=r"^pairs is "):
            takes_pairs([pair])
