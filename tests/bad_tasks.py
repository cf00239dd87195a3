"""A good task, and bad ones: (name, what to replace in the good one, by what, the field that the sentence names)."""

TINY_SCENE = """\
name = "tiny"
dimension = 2

[discretisation]
spacing = 0.05

[[phase]]
name = "water"
rest_density = 1000.0
viscosity = 0.05

[[fluid]]
shape = "box"
lower = [0.0, 0.0]
upper = [0.4, 0.4]
phase = "water"

[container]
shape = "box"
lower = [0.0, 0.0]
upper = [0.7, 0.8]

[solver]
kind = "pcisph"
time_step = 0.0021
minimum_iterations = 3
maximum_iterations = 3
"""
"""64 particles that fall and spread."""

GOOD_TASK = f"""\
{TINY_SCENE}
[problem]
steps = 5
target.gravity = [1.5, -9.81]

[optimise]
start.gravity = [0.0, -7.0]
optimiser = "adam"
learning_rate = 0.5
iterations = 6

[optimise.check]
loss_reduction = 2.0
parameter_error = 0.5
"""
PARTICLES = 64

_TABLES = GOOD_TASK[GOOD_TASK.index("[problem]") :]
_OPTIMISE = GOOD_TASK[GOOD_TASK.index("[optimise]") :]
_TARGET, _START = "target.gravity = [1.5, -9.81]", "start.gravity = [0.0, -7.0]"
_CHECK, _SMOOTHING = "[optimise.check]", '[optimise.gradient]\nname = "adjoint_viscosity"\n'
_RATE, _STEPS = "learning_rate = 0.5", "steps = 5"
_ROWS = "start.gravity = [[0.0, -7.0], [0.0, -8.0]]"
_PURE = [[1.0]] * PARTICLES


def _both(name: str, value: object, option: str = "") -> str:
    """The tables with another parameter, its true value and that to begin with, and an option of the optimisation."""
    start = f"start.{name} = {value}\n{option}"
    return _TABLES.replace(_TARGET, f"target.{name} = {value}").replace(_START, start)


BAD_TASKS = [
    ("no optimise", _OPTIMISE, "", "optimise"),
    ("no target", _TARGET, "", "problem.target"),
    ("target that is a list", _TARGET, "target = [1.5, -9.81]", "problem.target"),
    ("unknown parameter", _START, "start.gravitation = [0.0, -7.0]", "optimise.start.gravitation"),
    ("fit beside optimise", _CHECK, f"[fit]\nstart.gravity = [0.0, -9.0]\n\n{_CHECK}", "fit"),
    ("start without target", _START, "start.gravity = [0.0, -7.0]\nstart.viscosity = 0.1", "problem.target.viscosity"),
    ("gravity of three", _START, "start.gravity = [0.0, -7.0, 0.0]", "optimise.start.gravity"),
    ("gravity that is a number", _TARGET, "target.gravity = -9.81", "problem.target.gravity"),
    ("gravity of more rows than steps", _TARGET, f"target.gravity = {[[0.0, 1.0]] * 6}", "problem.target.gravity"),
    ("ragged gravity", _TARGET, "target.gravity = [[0.0, 1.0], [0.0]]", "problem.target.gravity"),
    ("gravity that is not finite", _START, "start.gravity = [0.0, nan]", "optimise.start.gravity"),
    ("negative time step", _TARGET, f"{_TARGET}\ntarget.time_step = -0.001", "problem.target.time_step"),
    ("no density", _TABLES, _TABLES.replace(_START, "start.rest_density = 0.0").replace(
        _TARGET, "target.rest_density = 900"), "optimise.start.rest_density"),
    ("fewer than no steps", "steps = 5", "steps = -1", "problem.steps"),
    ("rows where no time passes", _TABLES, _TABLES.replace("steps = 5", "steps = 0").replace(
        _TARGET, "target.gravity = [[0.0, 1.0], [0.0, 2.0]]"), "problem.target.gravity"),
    ("no iterations", "iterations = 6", "iterations = 0", "optimise.iterations"),
    ("unknown optimiser", '"adam"', '"adamw"', "optimise.optimiser"),
    ("no learning rate", "learning_rate = 0.5", "", "optimise.learning_rate"),
    ("negative learning rate", "learning_rate = 0.5", "learning_rate = -0.5", "optimise.learning_rate"),
    ("tolerance of Adam", _RATE, f"{_RATE}\ntolerance = 1e-5", "optimise.tolerance"),
    ("tolerance of all", '"adam"', '"lbfgs"\ntolerance = 1.0', "optimise.tolerance"),
    ("reduction below one", "loss_reduction = 2.0", "loss_reduction = 0.5", "optimise.check.loss_reduction"),
    ("wrong scene", "spacing = 0.05", "spacing = -0.05", "discretisation.spacing"),
    ("unknown loss", _STEPS, f'{_STEPS}\nloss = "picture"', "problem.loss"),
    ("picture and target", _TARGET, f'loss = "image"\npicture = "heart"\n{_TARGET}', "problem.picture"),
    ("neither picture nor target", _TARGET, 'loss = "image"', "problem.target"),
    ("picture of positions", _TARGET, 'picture = "heart"', "problem.loss"),
    ("several frames of a picture", _TARGET, 'loss = "image"\npicture = "heart"\nframes = 2', "problem.frames"),
    ("unknown distance", _STEPS, f'{_STEPS}\nloss = "image"\ndistance = "manhattan"', "problem.distance"),
    ("top of the plane", "[problem]", '[render]\nview = "top"\n[problem]', "render.view"),
    ("random gravity", _START, 'start.gravity = "random"', "optimise.start.gravity"),
    ("fractions beyond 1", _TABLES, _both("mass_fractions", [[1.5]] * PARTICLES), "problem.target.mass_fractions[0]"),
    ("negative viscosity", _TABLES, _both("viscosity", -0.1), "problem.target.viscosity"),
    ("colours of two phases", _TABLES, _both("colours", [[1.0] * 3] * 2), "problem.target.colours"),
    ("tilt beside gravity", _TARGET, f"{_TARGET}\ntarget.tilt = [5.0]", "problem.target.gravity"),
    ("true gravity, sought tilt", _START, "start.tilt = [0.0]", "problem.target.tilt"),
    ("start beyond the bounds of a tilt", _TABLES, _both("tilt", [50.0], "bounds.tilt = [-30.0, 30.0]"),
     "optimise.start.tilt"),
    ("unknown estimator", _CHECK, f'[optimise.gradient]\nname = "adjoint"\n{_CHECK}', "optimise.gradient.name"),
    ("an odd number of samples", _CHECK, f"{_SMOOTHING}samples = 5\nspread.gravity = 0.1\n{_CHECK}",
     "optimise.gradient.samples"),
    ("position noise of one sample", _CHECK, f"{_SMOOTHING}position_noise = 0.0\n{_CHECK}",
     "optimise.gradient.position_noise"),
    ("samples without a spread", _CHECK, f"{_SMOOTHING}samples = 4\n{_CHECK}", "optimise.gradient.spread"),
    ("spread of one sample", _CHECK, f"{_SMOOTHING}spread.gravity = 0.1\n{_CHECK}", "optimise.gradient.spread"),
    ("one knot", _RATE, f"{_RATE}\nknots = 1", "optimise.knots"),
    ("knots of a constant", _RATE, f"{_RATE}\nknots = 3", "optimise.knots"),
    ("logarithm of a negative number", _RATE, f'{_RATE}\nlogarithmic = ["gravity"]', "optimise.start.gravity"),
    ("logarithm of what is not optimised", _RATE, f'{_RATE}\nlogarithmic = ["viscosity"]', "optimise.logarithmic"),
    ("logarithm of knots", _START, f'{_ROWS}\nknots = 2\nlogarithmic = ["gravity"]', "optimise.logarithmic"),
    ("bounds of what is not optimised", _RATE, f"{_RATE}\nbounds.viscosity = [0.1, 0.2]", "optimise.bounds.viscosity"),
    ("one bound", _RATE, f"{_RATE}\nbounds.gravity = 20.0", "optimise.bounds.gravity"),
    ("bounds upside down", _RATE, f"{_RATE}\nbounds.gravity = [[-9.0, 9.0], [9.0, -9.0]]", "optimise.bounds.gravity"),
    ("start outside", _RATE, f"{_RATE}\nbounds.gravity = [-5.0, 5.0]", "optimise.start.gravity"),
    ("bounds of fractions", _TABLES, _both("mass_fractions", _PURE, "bounds.mass_fractions = [0.0, 1.0]"),
     "optimise.bounds.mass_fractions"),
    ("density down to zero", _TABLES, _both("rest_density", 900.0, "bounds.rest_density = [0.0, 1e3]"),
     "optimise.bounds.rest_density"),
    ("bound of a logarithm that is zero", _TABLES,
     _both("viscosity", 0.1, 'logarithmic = ["viscosity"]\nbounds.viscosity = [0.0, 1.0]'),
     "optimise.bounds.viscosity"),
    ("noise of positions", "loss_reduction = 2.0", "psnr = 30.0", "optimise.check.psnr"),
    ("true parameters of a picture", _TARGET, 'loss = "image"\npicture = "heart"', "optimise.check.parameter_error"),
]  # fmt: skip

TINY_BLOCK = (
    TINY_SCENE.replace("dimension = 2", "dimension = 3")
    .replace("[0.0, 0.0]", "[0.0, 0.0, 0.0]")
    .replace("[0.4, 0.4]", "[0.4, 0.4, 0.2]")
    .replace("[0.7, 0.8]", "[0.7, 0.8, 0.4]")
)
"""The tiny scene in space."""

PLANE_PICTURE = f"""\
{TINY_SCENE.replace("viscosity = 0.05", "viscosity = 0.05" + chr(10) + "colour = [0.9, 0.8, 0.7]")}
[render]
view = "plane"
resolution = [20, 16]
background = [0.3, 0.2, 0.1]

[problem]
steps = 0
loss = "image"
distance = "pyramid"
picture = "heart"

[optimise]
start.initial_positions = "random"
learning_rate = 0.02
iterations = 4

[optimise.check]
psnr = 3.0
"""
"""The same particles are moved into a picture; no time passes."""

TINY_LATTE = """\
name = "tiny latte"
dimension = 3
discretisation = { spacing = 0.0035 }
phase = [
  { name = "coffee", rest_density = 1000.0, viscosity = 0.02, colour = [0.20, 0.09, 0.04] },
  { name = "milk", rest_density = 900.0, viscosity = 0.04, colour = [0.95, 0.92, 0.85] },
]
fluid = [
  { shape = "cylinder", base = [0.0, 0.0, 0.0], radius = 0.0105, height = 0.007, phase = "coffee" },
  { shape = "cylinder", base = [0.0, 0.007, 0.0], radius = 0.006, height = 0.0035, phase = "milk" },
]
container = { shape = "cylinder", base = [0.0, 0.0, 0.0], radius = 0.0105, height = 0.03 }
mixture = { mobility = 1e-5 }
solver = { kind = "pcisph", time_step = 0.002, minimum_iterations = 3, maximum_iterations = 3 }
render = { view = "top", resolution = [16, 12] }

[problem]
steps = 6
loss = "image"
target.gravity = [[0.0, -9.81, 4.0], [4.0, -9.81, 0.0]]

[optimise]
start.gravity = [[0.0, -9.81, 0.0], [0.0, -9.81, 0.0]]
knots = 3
learning_rate = 0.5
iterations = 3

[optimise.check]
parameter_error = 2.0
"""
"""A small cup that is swung around, seen from above."""
LATTE_PARTICLES = 65
