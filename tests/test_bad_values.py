"""Values of a wrong type, given to whatever a user may call: a sentence each, and never a bare error of Python's."""

import importlib
import inspect
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
from cortado.errors import CortadoError, InputError
from cortado.optimisation.transforms import Affine, Logarithm, Softmax, TimeInterpolation, Transformed

WRONG = {
    "nothing": None,
    "a number": 3,
    "a truth": True,
    "no text": "",
    "below 0": -1,
    "a fraction": 2.5,
    "a list": [],
    "a table": {},
    "an object": object(),
    "a folder": mkdtemp(),
    "no number": float("nan"),
    "an array": np.zeros(3),
    "bytes": b"x",
    "a table of a truth": {True: 1},
    "a table of nothing": {"gravity": None},
    "a path": Path(mkdtemp()),
    "a letter": "x",
    "a large number": 10**12,
    "no finite number": float("inf"),
    "a matrix": np.zeros((2, 2)),
    "a complex number": 1j,
}


@cache
def at():
    """What functions are called with, when all is well."""
    made = SimpleNamespace(scene=cortado.Scene(**plane()), loss=losses.CentreOfMass([0.0, 0.0]))
    made.start, made.u = {"gravity": [0.0, -9.0]}, {"viscosity": np.log(0.05)}
    made.simulation = cortado.Simulation(made.scene)
    made.problem = cortado.Problem(made.simulation, 2, made.loss)
    made.trajectory, made.renderer = made.simulation.run(2), made.simulation.renderer(resolution=(10, 8))
    made.image = made.renderer.render(made.trajectory[0])
    made.transformed = Transformed(made.problem, {"viscosity": Logarithm()})
    made.affine = Affine(np.zeros(2), np.ones((2, 3)))
    return made


CALLS = {
    "load_scene": lambda at: (cortado.load_scene, {"path": "scene.toml", "overrides": ()}),
    "from_json": lambda at: (cortado.Scene.from_json, {"text": at.scene.to_json(), "overrides": ()}),
    "Simulation": lambda at: (
        cortado.Simulation,
        {"scene": at.scene, "device": "cpu", "precision": "float32", "batch": None},
    ),
    "run": lambda at: (at.simulation.run, {"steps": 1, "controls": None, "record_every": 1, "state": None}),
    "Problem": lambda at: (
        cortado.Problem,
        {"simulation": at.simulation, "steps": 2, "loss": at.loss, "memory_budget": 10**8},
    ),
    "value": lambda at: (at.problem.value, {"parameters": at.start}),
    "estimate": lambda at: (at.problem.estimate, {"parameters": at.start, "gradient": None, "observe": None}),
    "tangent": lambda at: (at.problem.tangent, {"parameters": at.start, "directions": at.start}),
    "end": lambda at: (at.problem.end, {"parameters": at.start}),
    "states": lambda at: (at.problem.states, {"parameters": at.start, "steps": [1]}),
    "run of a problem": lambda at: (at.problem.run, {"parameters": at.start, "record_every": 1}),
    "tangents": lambda at: (
        at.problem.tangents,
        {"parameters": at.start, "directions": at.start, "observe": lambda step, dot: None, "steps": ()},
    ),
    "room": lambda at: (at.problem.room, {"estimator": None}),
    "together": lambda at: (at.problem.together, {"points": [at.start], "estimator": None}),
    "Transformed": lambda at: (Transformed, {"problem": at.problem, "coordinates": {"viscosity": Logarithm()}}),
    "parameters": lambda at: (at.transformed.parameters, {"u": at.u}),
    "coordinate": lambda at: (at.transformed.coordinate, {"parameters": {"viscosity": 0.05}}),
    "value of coordinates": lambda at: (at.transformed.value, {"u": at.u}),
    "estimate of coordinates": lambda at: (at.transformed.estimate, {"u": at.u, "gradient": None, "observe": None}),
    "room of coordinates": lambda at: (at.transformed.room, {"estimator": None}),
    "together in coordinates": lambda at: (at.transformed.together, {"points": [at.u], "estimator": None}),
    "exp": lambda at: (Logarithm().parameter, {"u": np.zeros(2)}),
    "log": lambda at: (Logarithm().coordinate, {"parameter": np.ones(2)}),
    "softmax": lambda at: (Softmax().parameter, {"u": np.zeros((2, 2))}),
    "inverse softmax": lambda at: (Softmax().coordinate, {"parameter": np.full((2, 2), 0.5)}),
    "TimeInterpolation": lambda at: (TimeInterpolation, {"steps": 4, "knots": 2}),
    "path": lambda at: (TimeInterpolation(4, 2).parameter, {"u": np.zeros((2, 2))}),
    "knots": lambda at: (TimeInterpolation(4, 2).coordinate, {"parameter": np.zeros((4, 2))}),
    "Affine": lambda at: (Affine, {"base": np.zeros(2), "matrix": np.ones((2, 3))}),
    "affine": lambda at: (at.affine.parameter, {"u": np.zeros(3)}),
    "inverse affine": lambda at: (at.affine.coordinate, {"parameter": np.zeros(2)}),
    "estimator": lambda at: (
        gradients.estimate,
        {"problem": at.problem, "parameters": at.start, "estimator": None, "observe": None},
    ),
    "map": lambda at: (cortado.executors.InProcess().map, {"function": str, "items": [1], "on_result": None}),
    "renderer": lambda at: (lambda **settings: at.simulation.renderer(**settings), {"resolution": (10, 8)}),
    "rollout": lambda at: (at.simulation.rollout, {"steps": 1, "controls": None, "state": None}),
    "optimise": lambda at: (
        cortado.optimise,
        {
            **{"problem": at.problem, "start": at.start, "optimiser": "adam", "iterations": 1, "learning_rate": 0.1},
            **{"bounds": None, "checkpoint": None, "resume": False, "on_iteration": None},
        },
    ),
    "evaluate": lambda at: (
        cortado.evaluate,
        {"problem": at.problem, "points": [at.start], "gradient": None, "executor": None, "on_result": None},
    ),
    "certify": lambda at: (
        cortado.certify,
        {"problem": at.problem, "parameters": ["gravity"], "perturbation": 1e-3, "seed": 0},
    ),
    "load": lambda at: (cortado.Trajectory.load, {"path": "run.vtkhdf"}),
    "save": lambda at: (at.trajectory.save, {"path": "run.vtkhdf"}),
    "Frames": lambda at: (losses.Frames, {"losses": {1: at.loss}}),
    "FinalPositions": lambda at: (losses.FinalPositions, {"target": at.trajectory[-1].positions}),
    "CentreOfMass": lambda at: (losses.CentreOfMass, {"target": [0.0, 0.0]}),
    "Image": lambda at: (losses.Image, {"renderer": at.renderer, "target": at.image, "distance": None}),
    "Recorded": lambda at: (losses.Recorded, {"function": lambda positions, velocities, loss: None}),
    "CentreOfMassAlong": lambda at: (losses.CentreOfMassAlong, {"direction": [0.0, 1.0]}),
    "Pyramid": lambda at: (cortado.image_losses.Pyramid, {"levels": 2, "weights": (1.0, 2.0)}),
    "Adam": lambda at: (optimisers.Adam, {"learning_rate": 0.1}),
    "LBFGS": lambda at: (optimisers.LBFGS, {"memory": 5}),
    "GradientDescent": lambda at: (optimisers.GradientDescent, {"learning_rate": 0.1}),
    "LineSearch": lambda at: (optimisers.LineSearch, {}),
    "Guided": lambda at: (gradients.Guided, {"samples": 4, "spread": 0.1}),
    "RandomizedSmoothing": lambda at: (gradients.RandomizedSmoothing, {"samples": 4, "spread": 0.1}),
    "EnsembleMean": lambda at: (
        gradients.EnsembleMean,
        {"samples": 4, "spread": 0.1, "seed": 0, "estimator": gradients.Exact()},
    ),
    "AdjointViscosity": lambda at: (gradients.AdjointViscosity, {"coefficient": 1.0, "limit": 4.0, "order": 1}),
    "read_picture": lambda at: (cortado.pictures.read_picture, {"path": "picture.png"}),
    "write_picture": lambda at: (cortado.pictures.write_picture, {"path": "picture.png", "image": at.image}),
    "rosetta": lambda at: (cortado.pictures.rosetta, {"resolution": 8}),
    "heart": lambda at: (cortado.pictures.heart, {"resolution": 8, "size": 0.5}),
    "TopView": lambda at: (
        cortado.render.TopView,
        {"lower": (0.0, 0.0), "upper": (1.0, 1.0), "spacing": 0.1, "resolution": (10, 8), "up_axis": 2},
    ),
}
"""By its name what is called, and good arguments of it."""
OTHERS = {
    **{"renderer": ["view", "background"], "certify": ["steps"], "CentreOfMassAlong": ["masses"]},
    **{"Adam": ["beta1", "beta2", "epsilon"], "LBFGS": ["tolerance", "scale"], "heart": ["cup", "milk"]},
    **{"LineSearch": ["scale", "trials", "shortest", "momentum"], "AdjointViscosity": ["base"]},
    **{"Guided": ["seed"], "RandomizedSmoothing": ["seed"]},
}
"""Arguments that may be left out."""


@pytest.mark.filterwarnings("ignore::cortado.errors.CortadoWarning")
@pytest.mark.parametrize("name", CALLS)
def test_a_wrong_value_works_or_is_a_sentence(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    function, good = CALLS[name](at())
    for argument, (words, wrong) in product([*good, *OTHERS.get(name, ())], WRONG.items()):
        try:
            function(**{**good, argument: wrong})
        except CortadoError as error:
            assert len(str(error)) > 10 and "\n" not in str(error), words
        except Exception as error:  # of Python's or of a library's
            pytest.fail(f"{argument} = {words}: {type(error).__name__}: {error}")


NUMBERS = {
    **{"Simulation": ["batch"], "run": ["steps", "record_every"], "Problem": ["steps", "memory_budget"]},
    **{"optimise": ["iterations"], "certify": ["seed", "perturbation"], "Pyramid": ["levels"], "LBFGS": ["memory"]},
    **{"Adam": ["learning_rate"], "EnsembleMean": ["samples", "seed"], "heart": ["resolution", "size"]},
}


@pytest.mark.parametrize("name", NUMBERS)
def test_a_truth_value_is_no_number(name):
    function, good = CALLS[name](at())
    for argument in NUMBERS[name]:
        assert argument in inspect.signature(function).parameters
        with pytest.raises(InputError):
            function(**{**good, argument: True})


ACCEPTED = [
    ("Image", "renderer", ["nothing", "a number", "a truth", "a table", "an object", "a class", "a letter"]),
    ("Recorded", "function", ["nothing", "a number", "a truth", "a table", "an object", "a class", "a letter"]),
    ("Transformed", "problem", ["nothing", "a number", "a truth", "a table", "an object", "a class", "a letter"]),
    ("Transformed", "coordinates", ["nothing", "a number", "a truth", "no text", "a list", "a table of nothing"]),
    ("states", "steps", ["nothing", "a number", "a letter", "a truth", "a table of a truth", "a table of nothing"]),
    ("log", "parameter", ["nothing", "a truth", "no number", "a complex number", "below 0"]),
    ("optimise", "resume", ["nothing", "a number", "no text", "an array"]),
]


@pytest.mark.parametrize("name, argument, wrong", ACCEPTED)
def test_what_cannot_be_used_is_refused(name, argument, wrong):
    function, good = CALLS[name](at())
    for words in wrong:
        with pytest.raises(InputError, match="must"):
            function(**{**good, argument: {**WRONG, "a class": int}[words]})


@pytest.mark.parametrize("steps", [[3], [-1], [1.5], [True], ["1"], [None], [1, 10**12]])
def test_states_are_those_of_steps_that_there_are(steps):
    states, good = CALLS["states"](at())
    with pytest.raises(InputError, match="a number of steps is"):
        states(**{**good, "steps": steps})
    assert list(states(**{**good, "steps": [0, 2.0]})) == [0, 2]


@pytest.mark.parametrize("frame", [True, False, "1", None, 1.5])
def test_frames_are_numbered(frame):
    with pytest.raises(InputError, match="losses has the frame"):
        losses.Frames({frame: losses.CentreOfMass([0.0, 0.0])})


def test_light_of_a_target_is_not_negative():
    target = at().image
    with pytest.raises(InputError, match=r"target has a value of -0.25, but must be linear light from 0 to 1"):
        losses.Image(at().renderer, np.where(target == target.max(), -0.25, target))


@pytest.mark.parametrize("name", ["mobility", "interface_width"])
def test_a_single_phase_has_no_parameters_of_a_mixture(name):
    with pytest.raises(InputError, match=f"{name} is given, but must be left out, as the scene has only one phase"):
        at().problem.value_and_gradient({name: 1e-6})


def test_guided_is_named_where_it_is_given_a_batch():
    problem = cortado.Problem(cortado.Simulation(cortado.Scene(**plane()), batch=2), 1, at().loss)
    with pytest.raises(InputError, match=r"^Guided is given a problem of a batch"):
        problem.estimate({"gravity": np.zeros((2, 1, 2))}, gradients.Guided())


MODULES = [name for name in cortado.__all__ if isinstance(getattr(cortado, name), ModuleType)]
PUBLIC = ["cortado", *(f"cortado.{name}" for name in [*MODULES, "environments", "jax"])]
ODD = {"nothing": None, "a number": 3.5, "a letter": "x", "a function of nothing": lambda: None}


@cache
def by_name():
    """Good arguments, by the names that functions and classes have for them."""
    found = {name: value for call in CALLS.values() for name, value in call(at())[1].items()}
    positions = found["problem"].end(found["start"]).positions
    found |= {"path": "run.vtkhdf", "sensor": cortado.sensors.WaveGauge([0.1, 0.0]), "dimension": 2}
    found |= {"position": [0.1, 0.1], "times": 0.001 * np.arange(1, 5), "values": np.zeros(4), "normal": [1.0, 0.0]}
    found |= {"noise": 0.1, "frames": np.zeros((4, 8, 10, 3)), "time_step": 0.0021, "task": "Carry"}
    return found | {"positions": positions}


def odd_calls(function):
    """Of a function or a class: without arguments, and with each argument, and all that are needed, of another kind."""
    takes = inspect.signature(function).parameters
    named = [name for name, one in takes.items() if one.kind in (one.POSITIONAL_OR_KEYWORD, one.KEYWORD_ONLY)]
    needed = [name for name in named if takes[name].default is inspect.Parameter.empty]
    first = sum(one.kind is one.POSITIONAL_ONLY for one in takes.values())
    good = {name: by_name().get(name) for name in needed}
    yield "no arguments", (), {}
    for words, odd in ODD.items():
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


@pytest.mark.filterwarnings("ignore::cortado.errors.CortadoWarning")
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
