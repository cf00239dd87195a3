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

BAD_TASKS = [
    ("no problem", _TABLES, _OPTIMISE, "problem"),
    ("no optimise", _OPTIMISE, "", "optimise"),
    ("neither table", _TABLES, "", "problem"),
    ("optimise that is a list", "[optimise]", "[[optimise]]", "optimise"),
    ("no target", _TARGET, "", "problem.target"),
    ("empty target", _TARGET, "target = {}", "problem.target"),
    ("target that is a list", _TARGET, "target = [1.5, -9.81]", "problem.target"),
    ("unknown parameter", _START, "start.gravitation = [0.0, -7.0]", "optimise.start.gravitation"),
    ("parameter of another table", _TARGET, "target.colours = [1.0]", "problem.target.colours"),
    ("start without target", _START, "start.gravity = [0.0, -7.0]\nstart.viscosity = 0.1", "problem.target.viscosity"),
    ("gravity of three", _START, "start.gravity = [0.0, -7.0, 0.0]", "optimise.start.gravity"),
    ("gravity that is a number", _TARGET, "target.gravity = -9.81", "problem.target.gravity"),
    ("gravity of two steps", _TARGET, "target.gravity = [[0.0, 1.0], [0.0, 2.0]]", "problem.target.gravity"),
    ("ragged gravity", _TARGET, "target.gravity = [[0.0, 1.0], [0.0]]", "problem.target.gravity"),
    ("gravity of nothing", _TARGET, "target.gravity = []", "problem.target.gravity"),
    ("gravity in text", _TARGET, 'target.gravity = ["1.5", "-9.81"]', "problem.target.gravity"),
    ("gravity of flags", _START, "start.gravity = [true, false]", "optimise.start.gravity"),
    ("gravity that is not finite", _START, "start.gravity = [0.0, nan]", "optimise.start.gravity"),
    ("gravity without end", _TARGET, "target.gravity = [inf, 0.0]", "problem.target.gravity"),
    ("gravity in a table", _TARGET, "target.gravity = {x = 1.5}", "problem.target.gravity"),
    ("velocities of one particle", _TARGET, f"{_TARGET}\ntarget.initial_velocities = [[0.0, 1.0]]",
     "problem.target.initial_velocities"),
    ("viscosity of two", _TARGET, f"{_TARGET}\ntarget.viscosity = [0.1, 0.2]", "problem.target.viscosity"),
    ("negative time step", _TARGET, f"{_TARGET}\ntarget.time_step = -0.001", "problem.target.time_step"),
    ("no density", _TABLES, _TABLES.replace(_START, "start.rest_density = 0.0").replace(
        _TARGET, "target.rest_density = 900"), "optimise.start.rest_density"),
    ("no steps", "steps = 5", "steps = 0", "problem.steps"),
    ("part of a step", "steps = 5", "steps = 2.5", "problem.steps"),
    ("steps left out", "steps = 5", "", "problem.steps"),
    ("misspelt steps", "steps = 5", "step = 5", "problem.step"),
    ("no iterations", "iterations = 6", "iterations = 0", "optimise.iterations"),
    ("iterations in text", "iterations = 6", 'iterations = "6"', "optimise.iterations"),
    ("unknown optimiser", '"adam"', '"adamw"', "optimise.optimiser"),
    ("no learning rate", "learning_rate = 0.5", "", "optimise.learning_rate"),
    ("negative learning rate", "learning_rate = 0.5", "learning_rate = -0.5", "optimise.learning_rate"),
    ("learning rate that is not a number", "learning_rate = 0.5", "learning_rate = nan", "optimise.learning_rate"),
    ("reduction below one", "loss_reduction = 2.0", "loss_reduction = 0.5", "optimise.check.loss_reduction"),
    ("error of zero", "parameter_error = 0.5", "parameter_error = 0.0", "optimise.check.parameter_error"),
    ("unknown check", "parameter_error", "gravity_error", "optimise.check.gravity_error"),
    ("wrong scene", "spacing = 0.05", "spacing = -0.05", "discretisation.spacing"),
    ("unknown table", "[problem]", "[problems]", "problems"),
]  # fmt: skip
