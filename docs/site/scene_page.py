"""``python docs/site/scene_page.py`` writes docs/scene_file.md, the page of all tables of a scene file.

The models in `cortado.scene` check scenes, and the page describes the keys of these models. The example of each table
is a valid scene together with `WHOLE`. `tests/test_docs.py` loads all examples.
"""

from pathlib import Path
from typing import Any

from rows import rows, shown, split, toml

from cortado.scene.scene import Scene

PAGE = Path(__file__).parents[1] / "scene_file.md"

WHOLE = """
name = "a block of water"
dimension = 3

[discretisation]
spacing = 0.05                      # m

[[phase]]
name = "water"
rest_density = 1000.0               # kg/m3
viscosity = 0.05                    # Pa s

[[fluid]]
shape = "box"
lower = [0.0, 0.0, 0.0]             # m
upper = [0.5, 0.5, 0.5]
phase = "water"

[container]
shape = "box"
lower = [0.0, 0.0, 0.0]
upper = [1.0, 1.0, 0.5]

[solver]
time_step = 0.002                   # s
"""

LINKS = {
    "discretisation": ("[table](#particles-discretisation)", "How the fluid is cut into particles."),
    "phase": ("[tables](#materials-phase)", "The materials: in this order the components of mass fractions."),
    "fluid": ("[tables](#bodies-of-fluid-fluid)", "The bodies of fluid; particles come in this order."),
    "emitter": ("[tables](#emitters-emitter)", "Openings out of which fluid comes; their particles come last."),
    "drain": ("[tables](#drains-drain)", "What takes particles out of the fluid."),
    "container": ("[table](#walls-container)", "What holds the fluid."),
    "solid": ("[tables](#solids-solid)", "What fluid flows around or is held by, besides the container."),
    "hinge": ("[tables](#hinges-hinge)", "Hinges, about which free bodies turn."),
    "spring": ("[tables](#springs-spring)", "Springs, which pull free bodies."),
    "mixture": ("[table](#fluids-that-mix-mixture)", "How phases mix."),
    "forces": ("[table](#forces-forces)", "Which forces act."),
    "force": ("[tables](#forces-of-packages-force)", "Forces of installed packages, which act besides."),
    "schedule": ("[table](#changes-over-time-schedule)", "What changes while the scene runs."),
    "solver": ("[table](#time-steps-solver)", "How a step is solved."),
    "sensor": ("[tables](#sensors-sensor)", "What is read of the fluid in every step."),
    "render": ("[table](#pictures-render)", "How pictures are taken."),
    "picture": ("[table](#shaded-pictures-picture)", "How shaded pictures and films are made."),
}
"""Type, with a link to the description, and meaning of each key that is a table."""


DEFAULTS = {
    "support": "`2.6` with the projection if `kernel` is left out too, else `2.0`",
    "kernel": '`"wendland_c2"` with the projection if `support` is left out too, else `"cubic_spline"`',
    "jitter": "`0.05` with the projection if all axes are periodic, else `0.0`",
}
"""Defaults of keys of `[discretisation]` that depend on the solver. `tests/test_facts.py` compares them with scenes."""
OF_EMITTERS = {"jitter": "`0.05` with the projection, else `0.0`"}
"""Defaults of keys of `[[emitter]]` that depend on the solver."""
DECIDED = {"DiscretisationTable": DEFAULTS, "EmitterTable": OF_EMITTERS}


def _with_law(rheology: str) -> str:
    """Return a phase with a law of viscosity."""
    return f'[[phase]]\nname = "water"\nrest_density = 1000.0\nviscosity = 0.05\nrheology = {rheology}'


BEGINNING = """# The scene file

This page is for whoever writes a scene and looks up a key: its type, unit, bounds, default and meaning. A scene says
what a simulation starts from, in [TOML](https://toml.io) and SI units. This is a whole file:

{whole}
    cortado run scene.toml --steps 200 --out runs/block

In Python the same keys are arguments, with lists of tables for `[[phase]]` and `[[fluid]]`:
`cortado.Scene(dimension=3, discretisation={{"spacing": 0.05}}, phase=[{{...}}], fluid=[{{...}}], solver={{...}})`.
A scene does not change once it is made. `scene.replaced("solver.time_step=0.001", "phase.water.viscosity=0.1")` is
another one.

d stands for the number of dimensions, 2 or 3. Defaults of vectors are for 3-D: in 2-D the last component is left out.
Keys that are *needed* have to be there, and all others may be left out. Cortado refuses what is wrong, with a sentence
that names the file and the key. Each example replaces the table of the same name in the file above.

## At the top of the file

{top}
The tables `[problem]` and `[optimise]` make a scene a [task](task_file.md).
"""

PARTS: list[tuple[str, str, tuple[tuple[str, str, str], ...]]] = [
    (
        "## Particles: `[discretisation]`",
        "Fluid is cut into particles that start on a regular lattice. Half the spacing shows smaller waves. It takes "
        "eight times as many particles in 3-D, and steps half as long ([how to choose it](cookbook.md)).",
        (("DiscretisationTable", "", '[discretisation]\nspacing = 0.05\nsupport = 3.0\nkernel = "wendland_c4"'),),
    ),
    (
        "## Materials: `[[phase]]`",
        "A phase is a material. A scene has one or several.",
        (
            (
                "Phase",
                "",
                '[[phase]]\nname = "water"\nrest_density = 1000.0\nviscosity = 0.001\ncolour = [0.1, 0.3, 0.8]',
            ),
        ),
    ),
    (
        "## Bodies of fluid: `[[fluid]]`",
        "What is filled with fluid at the start. Several bodies must not overlap.",
        (
            (
                "BoxFluid",
                "### A box of fluid",
                '[[fluid]]\nshape = "box"\nlower = [0.1, 0.0, 0.0]\nupper = [0.4, 0.6, 0.5]\n'
                'velocity = [1.0, 0.0, 0.0]\nphase = "water"',
            ),
            (
                "SphereFluid",
                "### A sphere of fluid",
                '[[fluid]]\nshape = "sphere"\ncentre = [0.5, 0.6, 0.25]\nradius = 0.2\nphase = "water"',
            ),
            (
                "CylinderFluid",
                "### A cylinder of fluid",
                '[[fluid]]\nshape = "cylinder"\nbase = [0.5, 0.1, 0.25]\nradius = 0.2\nheight = 0.4\nphase = "water"',
            ),
            (
                "MeshFluid",
                "### Fluid in a mesh",
                '[[fluid]]\nshape = "mesh"\nfile = "block.stl"\nscale = 0.001\nposition = [0.3, 0.3, 0.25]\n'
                'rotation = [0.0, 0.5, 0.0]\nphase = "water"',
            ),
            (
                "PolygonFluid",
                "### Fluid in a polygon",
                'name = "a wedge"\ndimension = 2\n\n[[fluid]]\nshape = "polygon"\n'
                'corners = [[0.0, 0.0], [0.6, 0.0], [0.0, 0.6]]\nphase = "water"\n\n'
                '[container]\nshape = "box"\nlower = [0.0, 0.0]\nupper = [1.0, 1.0]',
            ),
            (
                "PointsFluid",
                "### Fluid from a file",
                '[[fluid]]\nshape = "points"\nfile = "drop.npy"\nphase = "water"',
            ),
        ),
    ),
    (
        "## Emitters: `[[emitter]]`",
        "A column of particles waits behind each opening and comes out of it with one speed. With an emitter a scene "
        "may leave out `[[fluid]]` ([taps and drains](taps_and_drains.md)).",
        (
            (
                "EmitterTable",
                "",
                '[[emitter]]\nphase = "water"\noutlet = [0.75, 0.7, 0.25]\ndirection = [0.0, -1.0, 0.0]\nradius = 0.1\n'
                "length = 0.2\nflow_rate = 0.02",
            ),
            (
                "Course_emitter_path",
                "### An emitter that moves",
                '[[emitter]]\nphase = "water"\noutlet = [0.75, 0.7, 0.25]\nsides = [0.2, 0.1]\nflow_rate = 0.02\n\n'
                "[emitter.path]\ntimes = [0.0, 0.5]\nvalues = [[0.75, 0.7, 0.25], [0.65, 0.7, 0.25]]",
            ),
        ),
    ),
    (
        "## Drains: `[[drain]]`",
        "They take particles out of the fluid ([taps and drains](taps_and_drains.md)).",
        (
            (
                "SinkDrain",
                "### A sink",
                '[[drain]]\nshape = "sink"\nname = "hole"\nposition = [0.8, 0.0, 0.25]\nflow_rate = 0.02',
            ),
            (
                "BoxDrain",
                "### A box",
                '[[drain]]\nshape = "box"\nname = "overflow"\nlower = [0.9, 0.5, 0.0]\nupper = [1.0, 0.6, 0.5]',
            ),
            (
                "PlaneDrain",
                "### A plane, or a level",
                '[[drain]]\nshape = "plane"\nname = "outflow"\nposition = [0.9, 0.0, 0.0]\ndirection = [1.0, 0.0, 0.0]',
            ),
        ),
    ),
    (
        "## Walls: `[container]`",
        "What holds the fluid, at rest. Gravity that leans, the parameter `tilt`, tilts it. Without this table fluid "
        "is in free space.",
        (
            (
                "BoxContainer",
                "### A box with walls",
                '[container]\nshape = "box"\nlower = [0.0, 0.0, 0.0]\nupper = [1.0, 1.0, 0.5]\n'
                'periodic = [true, false, true]\nslip = "no"',
            ),
            (
                "CylinderContainer",
                "### A cup",
                '[container]\nshape = "cylinder"\nbase = [0.25, 0.0, 0.25]\nradius = 0.5\nheight = 1.0\nlid = false',
            ),
            ("NoContainer", "### No walls", '[container]\nshape = "none"'),
        ),
    ),
    (
        "## Viscosity that depends on the shear rate: `rheology`",
        'A law in a phase, in a scene with one phase and the viscous force "stress" ([thick fluids](viscosity.md)). '
        "Each number is a parameter, such as `carreau.flow_index`.",
        (
            ("PowerLaw", "### A power law", _with_law('{ kind = "power_law", flow_index = 0.6 }')),
            (
                "Carreau",
                "### Carreau's law",
                _with_law('{ kind = "carreau", relaxation_time = 0.2, flow_index = 0.5 }'),
            ),
            ("Bingham", "### Bingham's law", _with_law('{ kind = "bingham", yield_stress = 2.0 }')),
            (
                "HerschelBulkley",
                "### The law of Herschel and Bulkley",
                _with_law('{ kind = "herschel_bulkley", yield_stress = 2.0, flow_index = 0.7 }'),
            ),
        ),
    ),
    (
        "## Solids: `[[solid]]`",
        "What fluid flows around or is held by, besides the container: pillars, ramps, baffles, cups, tanks that lean, "
        "pistons, rotors, belts, meshes from files ([how they work](solids.md)).",
        (
            (
                "BoxSolid",
                "### A solid box",
                '[[solid]]\nname = "pillar"\nshape = "box"\nlower = [0.7, 0.0, 0.2]\nupper = [0.8, 0.6, 0.3]\n'
                "rotation = [0.0, 0.5, 0.0]",
            ),
            (
                "SphereSolid",
                "### A solid sphere",
                '[[solid]]\nname = "ball"\nshape = "sphere"\ncentre = [0.75, 0.2, 0.25]\nradius = 0.1\n'
                'motion = "path"\n'
                "times = [0.0, 0.5, 1.0]\npositions = [[0.75, 0.2, 0.25], [0.75, 0.5, 0.25], [0.75, 0.2, 0.25]]",
            ),
            (
                "CapsuleSolid",
                "### A capsule",
                '[[solid]]\nname = "rod"\nshape = "capsule"\nstart = [0.75, 0.2, 0.1]\nend = [0.75, 0.4, 0.4]\n'
                'radius = 0.06\nmotion = "path"\nangular_velocity = [0.0, 3.0, 0.0]',
            ),
            (
                "CylinderSolid",
                "### A solid cylinder",
                '[[solid]]\nname = "column"\nshape = "cylinder"\nbase = [0.75, 0.0, 0.25]\nradius = 0.1\n'
                'height = 0.8\nslip = "no"',
            ),
            (
                "CupSolid",
                "### A cup",
                '[container]\nshape = "none"\n\n[[solid]]\nname = "cup"\nshape = "cup"\nbase = [0.25, -0.1, 0.25]\n'
                "radius = 0.4\nheight = 0.7\nthickness = 0.1\nrotation = [0.0, 0.0, 0.2]",
            ),
            (
                "PlaneSolid",
                "### A plane",
                '[[solid]]\nname = "slope"\nshape = "plane"\nposition = [0.5, 0.2, 0.25]\nnormal = [-0.3, 1.0, 0.0]',
            ),
            (
                "MeshSolid",
                "### A mesh from a file",
                '[[solid]]\nname = "block"\nshape = "mesh"\nfile = "block.stl"\nscale = 0.001\n'
                "position = [0.75, 0.1, 0.25]",
            ),
            (
                "SheetSolid",
                "### A sheet",
                '[[solid]]\nname = "baffle"\nshape = "sheet"\n'
                "corners = [[0.5, 0.0, 0.0], [0.5, 0.4, 0.0], [0.5, 0.4, 0.5], [0.5, 0.0, 0.5]]",
            ),
            (
                "PolygonSolid",
                "### A polygon",
                'name = "a ramp"\ndimension = 2\n\n[[fluid]]\nshape = "box"\nlower = [0.0, 0.0]\nupper = [0.4, 0.6]\n'
                'phase = "water"\n\n[container]\nshape = "box"\nlower = [0.0, 0.0]\nupper = [1.0, 1.0]\n\n'
                '[[solid]]\nname = "ramp"\nshape = "polygon"\ncorners = [[0.5, 0.0], [1.0, 0.0], [1.0, 0.4]]',
            ),
        ),
    ),
    (
        "## Fluids that mix: `[mixture]`",
        "Where there are several phases, particles may exchange them with their neighbours "
        "([the equation](discretisation.md#diffusion-between-phases)).",
        (
            (
                "MixtureTable",
                "",
                '[[phase]]\nname = "water"\nrest_density = 1000.0\nviscosity = 0.01\n\n[[phase]]\nname = "ink"\n'
                'rest_density = 900.0\nviscosity = 0.02\n\n[mixture]\nfree_energy = "miscible"\nmobility = 1e-4\n'
                'mobility_form = "constant"',
            ),
        ),
    ),
    (
        "## Forces: `[forces]`",
        "",
        (("Forces", "", '[forces]\ngravity = [0.0, -1.62, 0.0]\nviscosity = "none"\nsurface_tension = 0.07'),),
    ),
    (
        "## Changes over time: `[schedule]`",
        "What changes while a scene runs, as values at some times, in the table or in "
        "[a file](solids.md#paths-from-files). So a box is shaken and a cup is tilted: walls stay, and gravity changes "
        "([runs](runs.md)).",
        (
            ("Schedule", "", "[schedule.gravity]\ntimes = [0.0, 0.1]\nvalues = [[0.0, -9.81, 0.0], [3.0, -9.81, 0.0]]"),
            (
                "Course_gravity",
                "### Gravity over time: `[schedule.gravity]`",
                "[schedule.gravity]\ntimes = [0.0, 0.1, 0.2]        # s\n"
                "values = [[0.0, -9.81, 0.0], [6.0, -9.81, 0.0], [0.0, -9.81, 0.0]]",
            ),
            (
                "Course_tilt",
                "### A tilt over time: `[schedule.tilt]`",
                "[schedule.tilt]\ntimes = [0.0, 0.5]\nvalues = [[0.0, 0.0], [20.0, 0.0]]",
            ),
        ),
    ),
    (
        "## Forces of packages: `[[force]]`",
        "Forces that installed packages register ([how](own_parts.md#a-package-that-scene-files-name)). `kind` is the "
        "name that its package gives a force, and its other keys, such as `k = 2.0`, are those of the force. They act "
        "besides those of `[forces]`, in the order of the file. Their parameters, such as `drag.k`, are differentiated "
        "and searched for as others are. Two forces of one kind need names of their own.",
        (),
    ),
    (
        "## Hinges: `[[hinge]]`",
        'About them bodies with `motion = "free"` turn ([hinges](bodies.md#hinges)).',
        (
            (
                "HingeTable",
                "",
                '[[solid]]\nname = "flap"\nshape = "box"\nlower = [0.7, 0.1, 0.1]\nupper = [0.8, 0.6, 0.4]\n'
                'motion = "free"\ndensity = 300.0\n\n[[hinge]]\nname = "pin"\nsolid = "flap"\n'
                "position = [0.75, 0.15, 0.25]\naxis = [0.0, 0.0, 1.0]",
            ),
        ),
    ),
    (
        "## Springs: `[[spring]]`",
        'They pull bodies with `motion = "free"` ([springs and mooring lines](bodies.md#springs-and-mooring-lines)).',
        (
            (
                "SpringTable",
                "",
                '[[solid]]\nname = "raft"\nshape = "box"\nlower = [0.6, 0.2, 0.1]\nupper = [0.9, 0.3, 0.4]\n'
                'motion = "free"\ndensity = 300.0\n\n[[spring]]\nname = "line"\nsolid = "raft"\n'
                "point = [0.9, 0.2, 0.25]\nanchor = [0.95, 0.0, 0.25]\nstiffness = 500.0\nslack = true",
            ),
        ),
    ),
    (
        "## Time steps: `[solver]`",
        "How the fluid is kept incompressible ([two ways](projection.md)). A time step beyond the limit of stability "
        'is warned of; "auto" [chooses each step](steps.md#steps-that-are-chosen). '
        "If `kind` names the solver of an installed package, the table has the shared keys and those of that solver.",
        (
            ("ProjectionSolver", "### The projection", "[solver]\ntime_step = 0.002\niterations = 4"),
            (
                "PcisphSolver",
                "### PCISPH",
                '[solver]\nkind = "pcisph"\ntime_step = 0.002\nminimum_iterations = 3\nmaximum_iterations = 100\n'
                "density_tolerance = 0.001",
            ),
        ),
    ),
    (
        "## Sensors: `[[sensor]]`",
        "What `cortado run` reads of the fluid in every step and writes to `sensors.csv` ([sensors](sensors.md)).",
        (
            (
                "PressureProbeTable",
                "### A pressure probe",
                '[[sensor]]\nkind = "pressure_probe"\nname = "probe"\nposition = [0.2, 0.1, 0.25]',
            ),
            (
                "WaveGaugeTable",
                "### A wave gauge",
                '[[sensor]]\nkind = "wave_gauge"\nname = "gauge"\nposition = [0.25, 0.0, 0.25]\nradius = 0.2',
            ),
            (
                "FlowRateTable",
                "### A flow through a plane",
                '[[sensor]]\nkind = "flow_rate"\nname = "flow"\nposition = [0.6, 0.0, 0.0]\nnormal = [1.0, 0.0, 0.0]',
            ),
            (
                "WallForceTable",
                "### The force on walls",
                '[[sensor]]\nkind = "wall_force"\nname = "left wall"\nupper = [0.5, 1.0, 0.5]',
            ),
            (
                "SolidLoadTable",
                "### The load on a solid",
                '[[solid]]\nname = "post"\nshape = "box"\nlower = [0.9, 0.0, 0.2]\nupper = [1.0, 0.6, 0.3]\n\n'
                '[[sensor]]\nkind = "solid_load"\nname = "load"\nsolid = "post"',
            ),
            (
                "SpringForceTable",
                "### The force in a spring",
                '[[solid]]\nname = "raft"\nshape = "box"\nlower = [0.6, 0.2, 0.1]\nupper = [0.9, 0.3, 0.4]\n'
                'motion = "free"\ndensity = 300.0\n\n[[spring]]\nname = "line"\nsolid = "raft"\n'
                "point = [0.9, 0.2, 0.25]\nanchor = [0.95, 0.0, 0.25]\nstiffness = 500.0\n\n"
                '[[sensor]]\nkind = "spring_force"\nname = "pull"\nspring = "line"',
            ),
            (
                "BodyMotionTable",
                "### The motion of a body",
                '[[solid]]\nname = "raft"\nshape = "box"\nlower = [0.6, 0.2, 0.1]\nupper = [0.9, 0.3, 0.4]\n'
                'motion = "free"\ndensity = 300.0\n\n'
                '[[sensor]]\nkind = "body_motion"\nname = "raft"\nsolid = "raft"',
            ),
        ),
    ),
    (
        "## Pictures: `[render]`",
        "How `simulation.renderer()`, `cortado run` and losses of images see the fluid ([rendering](rendering.md)).",
        (
            (
                "Render",
                "",
                '[render]\nview = "volume"\nposition = [1.5, 1.2, 2.0]\nlook_at = [0.5, 0.3, 0.25]\n'
                "field_of_view = 40.0\nresolution = [256, 192]",
            ),
        ),
    ),
    (
        "## Shaded pictures: `[picture]`",
        "The pictures and films that `cortado run`, `optimise` and `picture` write to be looked at "
        "([pictures](pictures.md)).",
        (
            (
                "Picture",
                "",
                "[picture]\nwidth = 1920\nheight = 1080\ncamera = [2.0, 1.4, 2.6]\nlook_at = [0.5, 0.3, 0.25]\n"
                'surface = "spheres"',
            ),
        ),
    ),
    (
        "## Cameras that move: `camera_path`",
        "How the camera of a film moves, a key of `[picture]` ([pictures](pictures.md#cameras-that-move)).",
        (
            ("Orbit", "### Around the scene", '[picture]\ncamera_path = {kind = "orbit", turns = 0.5}'),
            ("Dolly", "### Nearer or further away", '[picture]\ncamera_path = {kind = "dolly", distance = 0.5}'),
            (
                "Keyframes",
                "### Through places",
                '[picture.camera_path]\nkind = "keyframes"\ntimes = [0.0, 1.0]                  # s\n'
                "cameras = [[1.0, 1.0, 3.0], [3.0, 1.0, 1.0]]",
            ),
            (
                "Follow",
                "### With a solid",
                '[[solid]]\nname = "raft"\nshape = "box"\nlower = [0.6, 0.0, 0.1]\nupper = [0.8, 0.1, 0.4]\n\n'
                '[picture]\ncamera_path = {kind = "follow", solid = "raft"}',
            ),
        ),
    ),
]
"""Sections of the page: heading, text, and tables. Each table has the name of its model, a heading, and an example."""


def examples() -> dict[str, str]:
    """Return the examples by the name of the model."""
    return {model: example for _, _, tables in PARTS for model, _, example in tables}


COMMON = "Shared keys:"
NEXT = "*Next*: [a scene of your own](own_scene.md), [the cookbook](cookbook.md), [the task file](task_file.md)."


def page() -> str:
    """Return the page. Keys that tables of a section share appear once, before these tables."""
    schema: dict[str, Any] = Scene.model_json_schema()
    parts = [BEGINNING.format(whole=toml(WHOLE), top=rows(schema, LINKS)).rstrip("\n")]
    for heading, words, tables in PARTS:
        parts += [heading, words]
        headed = [schema["$defs"][model] for model, below, _ in tables if below]
        common, own = split(headed) if headed else ([], [])
        for model, below, example in tables:
            table = schema["$defs"][model]
            if not below:
                parts += [rows(table, defaults=DECIDED.get(model)), toml(example)]
                continue
            if common:
                parts += [COMMON, shown(common)]
                common = []
            said = "" if model.startswith("Course_") else table.get("description", "")  # [schedule] says it
            parts += [below, said.replace("``", "`"), shown(own.pop(0)), toml(example)]
    return "\n\n".join(part.rstrip("\n") for part in [*parts, NEXT] if part) + "\n"


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
