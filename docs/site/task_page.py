"""``python docs/site/task_page.py`` writes docs/task_file.md, the page of all tables of a task file.

The models in `cortado.optimisation.task_tables` check tasks, and the page describes the keys of these models. The
example of each table, appended to the scene of `scene_page`, is a valid task. `tests/test_docs.py` loads all examples.
"""

from pathlib import Path

from rows import rows, shown, split, toml

from cortado.optimisation.task_tables import FitTables, TaskTables

PAGE = Path(__file__).parents[1] / "task_file.md"

WHOLE = """
[problem]
steps = 50
target.gravity = [1.0, -9.0, 0.0]   # m/s2

[optimise]
start.gravity = [0.0, -9.81, 0.0]
optimiser = "lbfgs"
learning_rate = 1.0
iterations = 10
"""

WHOLE_FIT = """
[problem]
steps = 50

[[problem.measured]]
name = "scales"
kind = "sensor"
sensor = "floor"
file = "force.csv"

[fit]
start.viscosity = 0.5               # Pa s
"""

LINKS = {
    "measured": ("[list of tables](#what-was-measured-problemmeasured)", "What was measured; for `cortado fit`."),
    "also": (
        "list of files",
        "Files of other experiments with the same fluid, beside the task's own: scenes with a table [problem] of "
        "measured data; for `cortado fit`.",
    ),
    "calibrate": (
        "list",
        'What is searched beside the parameters: "start", the key `start`; of a camera "translation", "rotation", '
        '"field_of_view" or, in the plane, "width", and the fluid\'s "extinction".',
    ),
    "gradient": ("[table](#which-gradient-optimisegradient)", "The gradient that the search follows."),
    "check": ("[table](#what-has-to-be-reached-optimisecheck)", "What the estimate has to reach."),
}

BEGINNING = f"""# The task file

This page is for whoever writes a task and looks up a key. A task is a [scene](scene_file.md) with two more tables:
`[problem]` says what is to be reached, `[optimise]` how it is searched, or `[fit]` what is fitted to measured data.
[Tasks](tasks.md) explains them. Put these tables below the scene with which [the scene file](scene_file.md) begins.
They make a task that finds gravity:

{toml(WHOLE)}
    cortado optimise task.toml --out runs/task

Tables name [parameters](parameters.md), and those of [solids that
move](solids.md#where-solids-are-as-parameters), such as `target.paddle.displacement`. Keys that are *needed* have to be
there. Each example below replaces the table of the same name.
"""

PARTS = [
    (
        "## What is to be reached: `[problem]`",
        "ProblemTable",
        "A run of some steps, and a target: the end of a run with other parameters, or a picture.",
        '[problem]\nsteps = 30\nloss = "image"\ndistance = "pyramid"\nframes = 2\n'
        "target.gravity = [[1.0, -9.0, 0.0], [-1.0, -9.0, 0.0]]     # at the first and at the last step",
    ),
    (
        "## How it is searched: `[optimise]`",
        "OptimiseTable",
        "Which parameters are searched, from where, and how.",
        "[optimise]\nstart.gravity = [0.0, -9.81, 0.0]\nbounds.gravity = [-20.0, 20.0]       # m/s2\n"
        'optimiser = "adam"\nlearning_rate = 0.2                 # m/s2\niterations = 40',
    ),
    (
        "## Which gradient: `[optimise.gradient]`",
        "GradientTable",
        "In long runs exact gradients may be useless; [gradient estimators](gradients.md) says what to do then.",
        '[optimise.gradient]\nname = "adjoint_viscosity"\ncoefficient = 2.0\nsamples = 4\n'
        "spread.gravity = 0.5                # m/s2",
    ),
    (
        "## What has to be reached: `[optimise.check]`",
        "CheckTable",
        "The command fails, with exit code 1, unless all of it is reached.",
        "[optimise.check]\nloss_reduction = 100.0\nparameter_error = 0.01",
    ),
]
"""Sections of the page: heading, name of the model, text, and example."""

FIT_PARTS = [
    (
        "### Video",
        "VideoTable",
        "Frames of a video, or of a folder of pictures, beside what `[render]` shows.",
        '[[problem.measured]]\nname = "camera"\nkind = "video"\nfile = "experiment.mp4"\n'
        "start = -0.4                        # s: the fluid is let go 0.4 s after the video begins\n"
        "crop = [120, 40, 1400, 1000]        # pixels\n"
        'mask = "mask.png"\ncalibrate = ["translation", "field_of_view"]',
    ),
    (
        "### Sensor",
        "SensorSeriesTable",
        'A CSV file with a column "time" and columns named as the numbers of a [sensor](sensors.md#sensors).',
        '[[problem.measured]]\nname = "scales"\nkind = "sensor"\nsensor = "floor"\nfile = "force.csv"\n'
        "noise = 0.2                         # N",
    ),
    (
        "### Tracks",
        "TracksTable",
        'A CSV file with columns "time", "tracer" (a number), "x", "y" and in 3-D "z". Each tracer needs a line '
        "for the start of the run.",
        '[[problem.measured]]\nname = "tracers"\nkind = "tracks"\nfile = "tracks.csv"',
    ),
    (
        "## What is fitted: `[fit]`",
        "FitTable",
        "Which parameters are fitted to what was measured.",
        "[fit]\nstart.viscosity = 0.5               # Pa s\nbounds.viscosity = [0.01, 10.0]\nprofiles = 0",
    ),
]
"""Sections about tasks with measured data."""
MEASURED = """
## What was measured: `[[problem.measured]]`

In the place of a target: [fits of experiments](fits.md) explains it. Each table is something that was measured; below a
scene that has the sensor, these tables make a task for `cortado fit`:

"""


def examples() -> dict[str, str]:
    """Return the examples by the name of the model."""
    return {model: example for _, model, _, example in [*PARTS, *FIT_PARTS]}


def page() -> str:
    """Return the page. Keys that tables of measured data share appear once, before these tables."""
    tables = {**TaskTables.model_json_schema()["$defs"], **FitTables.model_json_schema()["$defs"]}
    sections = [
        f"\n{heading}\n\n{words}\n\n{rows(tables[model], LINKS)}\n{toml(example)}"
        for heading, model, words, example in [*PARTS, FIT_PARTS[-1]]
    ]
    common, own = split([tables[model] for _, model, _, _ in FIT_PARTS[:-1]], LINKS)
    measured = [
        f"\n{heading}\n\n{words}\n\n{shown(found)}\n{toml(example)}"
        for (heading, _, words, example), found in zip(FIT_PARTS[:-1], own, strict=True)
    ]
    fit = f"{MEASURED}{toml(WHOLE_FIT)}\n    cortado fit task.toml --out runs/fit\n\nShared keys:\n\n{shown(common)}"
    return "".join([BEGINNING, *sections[:-1], fit, *measured, sections[-1], NEXT])


NEXT = "\n*Next*: [tasks](tasks.md), [fits of experiments](fits.md), [the scene file](scene_file.md).\n"


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
