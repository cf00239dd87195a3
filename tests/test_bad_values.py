"""Values of a wrong type, given to whatever a user may call: a sentence each, and never a bare error of Python's."""

import importlib
import inspect
from contextlib import suppress
from functools import cache
from pathlib import Path
from tempfile import mkdtemp
from types import ModuleType

import numpy as np
import pytest

import cortado
from bad_scenes import plane
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
def calls():
    """By its name what is called, and good arguments of it."""
    scene = cortado.Scene(**plane())
    simulation = cortado.Simulation(scene)
    loss, start = cortado.losses.CentreOfMass([0.0, 0.0]), {"gravity": [0.0, -9.0]}
    problem = cortado.Problem(simulation, 2, loss)
    trajectory = simulation.run(2)
    gradients, losses, optimisers = cortado.gradients, cortado.losses, cortado.optimisers
    renderer = simulation.renderer(resolution=(10, 8))
    image = renderer.render(trajectory[0])
    transformed, u = Transformed(problem, {"viscosity": Logarithm()}), {"viscosity": np.log(0.05)}
    affine = Affine(np.zeros(2), np.ones((2, 3)))
    executor = cortado.executors.InProcess()
    search = {"problem": problem, "start": start, "optimiser": "adam", "iterations": 1, "learning_rate": 0.1}
    return {
        "load_scene": (cortado.load_scene, {"path": "scene.toml", "overrides": ()}),
        "from_json": (cortado.Scene.from_json, {"text": scene.to_json(), "overrides": ()}),
        "Simulation": (cortado.Simulation, {"scene": scene, "device": "cpu", "precision": "float32", "batch": None}),
        "run": (simulation.run, {"steps": 1, "controls": None, "record_every": 1, "state": None}),
        "Problem": (cortado.Problem, {"simulation": simulation, "steps": 2, "loss": loss, "memory_budget": 10**8}),
        "value": (problem.value, {"parameters": start}),
        "estimate": (problem.estimate, {"parameters": start, "gradient": None, "observe": None}),
        "tangent": (problem.tangent, {"parameters": start, "directions": start}),
        "end": (problem.end, {"parameters": start}),
        "states": (problem.states, {"parameters": start, "steps": [1]}),
        "run of a problem": (problem.run, {"parameters": start, "record_every": 1}),
        "tangents": (
            problem.tangents,
            {"parameters": start, "directions": start, "observe": lambda step, dot: None, "steps": ()},
        ),
        "room": (problem.room, {"estimator": None}),
        "together": (problem.together, {"points": [start], "estimator": None}),
        "Transformed": (Transformed, {"problem": problem, "coordinates": {"viscosity": Logarithm()}}),
        "parameters": (transformed.parameters, {"u": u}),
        "coordinate": (transformed.coordinate, {"parameters": {"viscosity": 0.05}}),
        "value of coordinates": (transformed.value, {"u": u}),
        "estimate of coordinates": (transformed.estimate, {"u": u, "gradient": None, "observe": None}),
        "room of coordinates": (transformed.room, {"estimator": None}),
        "together in coordinates": (transformed.together, {"points": [u], "estimator": None}),
        "exp": (Logarithm().parameter, {"u": np.zeros(2)}),
        "log": (Logarithm().coordinate, {"parameter": np.ones(2)}),
        "softmax": (Softmax().parameter, {"u": np.zeros((2, 2))}),
        "inverse softmax": (Softmax().coordinate, {"parameter": np.full((2, 2), 0.5)}),
        "TimeInterpolation": (TimeInterpolation, {"steps": 4, "knots": 2}),
        "path": (TimeInterpolation(4, 2).parameter, {"u": np.zeros((2, 2))}),
        "knots": (TimeInterpolation(4, 2).coordinate, {"parameter": np.zeros((4, 2))}),
        "Affine": (Affine, {"base": np.zeros(2), "matrix": np.ones((2, 3))}),
        "affine": (affine.parameter, {"u": np.zeros(3)}),
        "inverse affine": (affine.coordinate, {"parameter": np.zeros(2)}),
        "estimator": (
            gradients.estimate,
            {"problem": problem, "parameters": start, "estimator": None, "observe": None},
        ),
        "map": (executor.map, {"function": str, "items": [1], "on_result": None}),
        "renderer": (lambda **settings: simulation.renderer(**settings), {"resolution": (10, 8)}),
        "rollout": (simulation.rollout, {"steps": 1, "controls": None, "state": None}),
        "optimise": (
            cortado.optimise,
            {**search, "bounds": None, "checkpoint": None, "resume": False, "on_iteration": None},
        ),
        "evaluate": (
            cortado.evaluate,
            {"problem": problem, "points": [start], "gradient": None, "executor": None, "on_result": None},
        ),
        "certify": (cortado.certify, {"problem": problem, "parameters": ["gravity"], "perturbation": 1e-3, "seed": 0}),
        "load": (cortado.Trajectory.load, {"path": "run.vtkhdf"}),
        "save": (trajectory.save, {"path": "run.vtkhdf"}),
        "Frames": (losses.Frames, {"losses": {1: loss}}),
        "FinalPositions": (losses.FinalPositions, {"target": trajectory[-1].positions}),
        "CentreOfMass": (losses.CentreOfMass, {"target": [0.0, 0.0]}),
        "Image": (losses.Image, {"renderer": renderer, "target": image, "distance": None}),
        "Recorded": (losses.Recorded, {"function": lambda positions, velocities, loss: None}),
        "CentreOfMassAlong": (losses.CentreOfMassAlong, {"direction": [0.0, 1.0]}),
        "Pyramid": (cortado.image_losses.Pyramid, {"levels": 2, "weights": (1.0, 2.0)}),
        "Adam": (optimisers.Adam, {"learning_rate": 0.1}),
        "LBFGS": (optimisers.LBFGS, {"memory": 5}),
        "GradientDescent": (optimisers.GradientDescent, {"learning_rate": 0.1}),
        "LineSearch": (optimisers.LineSearch, {}),
        "Guided": (gradients.Guided, {"samples": 4, "spread": 0.1}),
        "RandomizedSmoothing": (gradients.RandomizedSmoothing, {"samples": 4, "spread": 0.1}),
        "EnsembleMean": (
            gradients.EnsembleMean,
            {"samples": 4, "spread": 0.1, "seed": 0, "estimator": gradients.Exact()},
        ),
        "AdjointViscosity": (gradients.AdjointViscosity, {"coefficient": 1.0, "limit": 4.0, "order": 1}),
        "read_picture": (cortado.pictures.read_picture, {"path": "picture.png"}),
        "write_picture": (cortado.pictures.write_picture, {"path": "picture.png", "image": image}),
        "rosetta": (cortado.pictures.rosetta, {"resolution": 8}),
        "heart": (cortado.pictures.heart, {"resolution": 8, "size": 0.5}),
        "TopView": (
            cortado.render.TopView,
            {"lower": (0.0, 0.0), "upper": (1.0, 1.0), "spacing": 0.1, "resolution": (10, 8), "up_axis": 2},
        ),
    }


ARGUMENTS = [
    (name, argument)
    for name, arguments in {
        "load_scene": ("path", "overrides"),
        "from_json": ("text", "overrides"),
        "Simulation": ("scene", "device", "precision", "batch"),
        "run": ("steps", "controls", "record_every", "state"),
        "Problem": ("simulation", "steps", "loss", "memory_budget"),
        "value": ("parameters",),
        "estimate": ("parameters", "gradient", "observe"),
        "tangent": ("parameters", "directions"),
        "end": ("parameters",),
        "states": ("parameters", "steps"),
        "run of a problem": ("parameters", "record_every"),
        "tangents": ("parameters", "directions", "observe", "steps"),
        "room": ("estimator",),
        "together": ("points", "estimator"),
        "Transformed": ("problem", "coordinates"),
        "parameters": ("u",),
        "coordinate": ("parameters",),
        "value of coordinates": ("u",),
        "estimate of coordinates": ("u", "gradient", "observe"),
        "room of coordinates": ("estimator",),
        "together in coordinates": ("points", "estimator"),
        "exp": ("u",),
        "log": ("parameter",),
        "softmax": ("u",),
        "inverse softmax": ("parameter",),
        "TimeInterpolation": ("steps", "knots"),
        "path": ("u",),
        "knots": ("parameter",),
        "Affine": ("base", "matrix"),
        "affine": ("u",),
        "inverse affine": ("parameter",),
        "estimator": ("problem", "parameters", "estimator", "observe"),
        "map": ("function", "items", "on_result"),
        "renderer": ("resolution", "view", "background"),
        "rollout": ("steps", "controls", "state"),
        "optimise": ("problem", "start", "optimiser", "iterations", "bounds", "checkpoint", "resume", "on_iteration"),
        "evaluate": ("problem", "points", "gradient", "executor", "on_result"),
        "certify": ("problem", "parameters", "perturbation", "seed", "steps"),
        "load": ("path",),
        "save": ("path",),
        "Frames": ("losses",),
        "FinalPositions": ("target",),
        "CentreOfMass": ("target",),
        "CentreOfMassAlong": ("direction", "masses"),
        "Image": ("renderer", "target", "distance"),
        "Recorded": ("function",),
        "Pyramid": ("levels", "weights"),
        "Adam": ("learning_rate", "beta1", "beta2", "epsilon"),
        "GradientDescent": ("learning_rate",),
        "LBFGS": ("memory", "tolerance", "scale"),
        "LineSearch": ("scale", "trials", "shortest", "momentum"),
        "Guided": ("samples", "spread", "seed"),
        "RandomizedSmoothing": ("samples", "spread", "seed"),
        "EnsembleMean": ("samples", "spread", "seed", "estimator"),
        "AdjointViscosity": ("coefficient", "limit", "order", "base"),
        "read_picture": ("path",),
        "write_picture": ("path", "image"),
        "heart": ("resolution", "size", "cup", "milk"),
        "rosetta": ("resolution",),
        "TopView": ("lower", "upper", "spacing", "resolution", "up_axis"),
    }.items()
    for argument in arguments
]


@pytest.mark.filterwarnings("ignore::cortado.errors.CortadoWarning")
@pytest.mark.parametrize("name, argument", ARGUMENTS)
def test_a_wrong_value_works_or_is_a_sentence(name, argument, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    function, good = calls()[name]
    for words, wrong in WRONG.items():
        try:
            function(**{**good, argument: wrong})
        except CortadoError as error:
            assert len(str(error)) > 10 and "\n" not in str(error), words
        except Exception as error:  # of Python's or of a library's
            pytest.fail(f"{argument} = {words}: {type(error).__name__}: {error}")


NUMBERS = [
    ("Simulation", "batch"),
    ("run", "steps"),
    ("run", "record_every"),
    ("Problem", "steps"),
    ("Problem", "memory_budget"),
    ("optimise", "iterations"),
    ("certify", "seed"),
    ("certify", "perturbation"),
    ("Pyramid", "levels"),
    ("Adam", "learning_rate"),
    ("LBFGS", "memory"),
    ("EnsembleMean", "samples"),
    ("EnsembleMean", "seed"),
    ("heart", "resolution"),
    ("heart", "size"),
]


@pytest.mark.parametrize("name, argument", NUMBERS)
def test_a_truth_value_is_no_number(name, argument):
    function, good = calls()[name]
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
    function, good = calls()[name]
    for words in wrong:
        with pytest.raises(InputError, match="must"):
            function(**{**good, argument: {**WRONG, "a class": int}[words]})


@pytest.mark.parametrize("steps", [[3], [-1], [1.5], [True], ["1"], [None], [1, 10**12]])
def test_states_are_those_of_steps_that_there_are(steps):
    states, good = calls()["states"]
    with pytest.raises(InputError, match="a number of steps is"):
        states(**{**good, "steps": steps})
    assert list(states(**{**good, "steps": [0, 2.0]})) == [0, 2]


@pytest.mark.parametrize("frame", [True, False, "1", None, 1.5])
def test_frames_are_numbered(frame):
    with pytest.raises(InputError, match="losses has the frame"):
        cortado.losses.Frames({frame: cortado.losses.CentreOfMass([0.0, 0.0])})


def test_light_of_a_target_is_not_negative():
    (renderer, target) = (calls()["Image"][1][name] for name in ("renderer", "target"))
    with pytest.raises(InputError, match=r"target has a value of -0.25, but must be linear light from 0 to 1"):
        cortado.losses.Image(renderer, np.where(target == target.max(), -0.25, target))


@pytest.mark.parametrize("name", ["mobility", "interface_width"])
def test_a_single_phase_has_no_parameters_of_a_mixture(name):
    problem = calls()["Problem"][1]
    with pytest.raises(InputError, match=f"{name} is given, but must be left out, as the scene has only one phase"):
        cortado.Problem(**problem).value_and_gradient({name: 1e-6})


def test_guided_is_named_where_it_is_given_a_batch():
    problem = cortado.Problem(cortado.Simulation(cortado.Scene(**plane()), batch=2), 1, calls()["Problem"][1]["loss"])
    with pytest.raises(InputError, match=r"^Guided is given a problem of a batch"):
        problem.estimate({"gravity": np.zeros((2, 1, 2))}, cortado.gradients.Guided())


MODULES = [name for name in cortado.__all__ if isinstance(getattr(cortado, name), ModuleType)]
PUBLIC = ["cortado", *(f"cortado.{name}" for name in [*MODULES, "environments", "jax"])]
ODD = {"nothing": None, "a number": 3.5, "a letter": "x", "a function of nothing": lambda: None}


@cache
def by_name():
    """Good arguments, by the names that functions and classes have for them."""
    found = {name: value for _, arguments in calls().values() for name, value in arguments.items()}
    positions = found["problem"].end(found["start"]).positions
    own = {
        "path": "run.vtkhdf",
        "sensor": cortado.sensors.WaveGauge([0.1, 0.0]),
        "dimension": 2,
        "position": [0.1, 0.1],
    }
    own |= {
        "position": [0.1, 0.1],
        "times": 0.001 * np.arange(1, 5),
        "values": np.zeros(4),
        "normal": [1.0, 0.0],
        "noise": 0.1,
    }
    own |= {"frames": np.zeros((4, 8, 10, 3)), "time_step": 0.0021, "task": "Carry", "positions": positions}
    return {**found, **own}


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
        cortado.optimisers.Adam()
    with pytest.raises(
        InputError, match=r"^on_result takes the arguments '\(\)', but must take 2: the number of a point, "
    ):
        cortado.evaluate(by_name()["problem"], [{}], on_result=lambda: None)

    def fails(number, estimate):
        raise ValueError("of their own")

    with pytest.raises(ValueError, match="of their own"):
        cortado.evaluate(by_name()["problem"], [{}], on_result=fails)
