"""What one begins with: ``cortado new``, a commented scene, one of ten, and ``cortado examples``."""

import ast
import textwrap
import tomllib
from pathlib import Path
from string import Template

from cortado.errors import InputError, shown
from cortado.files.input_files import SCHEMA, examples_folder
from cortado.files.output_files import is_taken, sentences, write_atomically
from cortado.files.terminal import is_quiet

_SCENE = Template("""\
#:schema ./scene.schema.json
# A dam breaks: $particles particles in $dimension-D. Run it: cortado run $file
# Lines that begin with # and no space are switched off: remove the # to try them. All units are SI.
name = "$name"
dimension = $dimension

[discretisation]
spacing = $spacing                      # m, between particles at rest: half of it is $more times as many
support = 2.6                       # how far a particle sees, in spacings
kernel = "wendland_c2"              # or "wendland_c4" with a support of 3, "cubic_spline" with 2

# Materials: a table for each.
[[phase]]
name = "water"
rest_density = 1000.0               # kg/m3
viscosity = 0.05                    # Pa s; water has 0.001, which needs many more particles
colour = [0.1, 0.3, 0.8]            # red, green, blue, from 0 to 1

# A second fluid: switch on this table, the next [[fluid]], and [mixture] if the two shall mix.
#[[phase]]
#name = "oil"
#rest_density = 800.0
#viscosity = 0.2
#colour = [0.9, 0.7, 0.1]

# Bodies of fluid: a table for each, with the shape "box", $shapes or "points".
[[fluid]]
shape = "box"
lower = $water_lower             # m
upper = $water_upper
velocity = $zero          # m/s
phase = "water"

#[[fluid]]
#shape = "box"
#lower = $oil_lower
#upper = $oil_upper
#phase = "oil"

#[mixture]
#free_energy = "miscible"           # or "double_well", whose phases separate
#mobility = 1e-5                    # m2/s, how fast they diffuse into each other

[container]
shape = "box"                       # or $containers
lower = $zero
upper = $room
slip = "free"                       # "no" for walls that hold the fluid back

[forces]
gravity = $gravity        # m/s2
viscosity = "stress"                # or "none"
#surface_tension = 0.07             # N/m

[solver]
kind = "projection"                 # or "pcisph", which has other keys than iterations and repairs
time_step = 0.002                   # s; `cortado describe` says what limits it; "auto" chooses it before each step
iterations = 4                      # of the pressure, in every step
repairs = 2                         # that bring particles back to the rest density

# What changes over time: gravity, as in a box that is shaken, "tilt", or the "nozzle_path" of an [emitter].
#[schedule.gravity]
#times = [0.0, 0.1, 0.2, 0.3]       # s; linear in between
#values = $shake

# Pictures of the fluid itself, beside those of its particles.
#[render]
#view = "$view"
#resolution = [192, 144]
""")
_DIMENSIONS = {
    2: {
        "particles": 288,
        "spacing": "0.02",
        "more": 4,
        "shapes": '"sphere"',
        "containers": '"none"',
        "water_lower": "[0.0, 0.0]",
        "water_upper": "[0.24, 0.48]",
        "oil_lower": "[0.4, 0.0]",
        "oil_upper": "[0.6, 0.2]",
        "zero": "[0.0, 0.0]",
        "room": "[0.8, 0.6]",
        "gravity": "[0.0, -9.81]",
        "shake": "[[0.0, -9.81], [6.0, -9.81], [-6.0, -9.81], [0.0, -9.81]]",
        "view": "plane",
    },
    3: {
        "particles": 864,
        "spacing": "0.04",
        "more": 8,
        "shapes": '"sphere", "cylinder"',
        "containers": '"cylinder", "none"',
        "water_lower": "[0.0, 0.0, 0.0]",
        "water_upper": "[0.24, 0.48, 0.48]",
        "oil_lower": "[0.4, 0.0, 0.0]",
        "oil_upper": "[0.6, 0.2, 0.48]",
        "zero": "[0.0, 0.0, 0.0]",
        "room": "[0.8, 0.6, 0.48]",
        "gravity": "[0.0, -9.81, 0.0]",
        "shake": "[[0.0, -9.81, 0.0], [6.0, -9.81, 0.0], [-6.0, -9.81, 0.0], [0.0, -9.81, 0.0]]",
        "view": "top",
    },
}
"""What differs between 2-D and 3-D."""


DAM = "dam"
"""The template that explains every line, in 2-D and in 3-D."""
TEMPLATES = Path(__file__).parents[1] / "templates"
"""Files of the others, each a scene whose first line says what it is and how it is run."""
_SCENE_FILE = "SCENE.toml"
"""What that line calls the file."""


ALL = "all"
DATA = (".csv", ".mp4")
"""What an example may read, with its own name at the beginning: example_ANY.csv."""


def templates() -> list[str]:
    """Their names."""
    return [DAM, *sorted(path.stem for path in TEMPLATES.glob("*.toml"))]


def new_scene(path: Path, template: str, dimension: int | None) -> str:
    """Write a scene, and beside it the schema that editors complete and check it with; nothing that is there is
    replaced."""
    if template not in templates():
        raise InputError(f"--template is {shown(template)}, but must be one of {', '.join(templates())}.")
    if dimension is not None and template != DAM:
        raise InputError(f"--dimension is given, but must be left out, as only {DAM} is there in 2-D and in 3-D.")
    if dimension not in (None, *_DIMENSIONS):
        raise InputError(f"--dimension is {dimension}, but must be 2 or 3.")
    if path.name in ("", ".."):
        raise InputError("NAME must be the name of a file, such as dam.toml.")
    file = path if path.suffix == ".toml" else path.with_name(f"{path.name}.toml")
    if is_taken(file):
        raise InputError(f"{file} is already there; choose another NAME, or remove it.")
    schema = file.with_name(SCHEMA.name)
    with sentences(file.parent):
        file.parent.mkdir(parents=True, exist_ok=True)
    text, options = (scene_text(file, dimension or 2), "") if template == DAM else template_text(file, template)
    write_atomically(file, text)
    if not is_taken(schema):
        write_atomically(schema, SCHEMA.read_bytes())
    return f"The scene is {file}; {schema} tells editors what may stand in it. Run it: cortado run {file}{options}"


def scene_text(file: Path, dimension: int) -> str:
    """The scene that is written to a file."""
    named = _printable(file.name)
    return _SCENE.substitute(_DIMENSIONS[dimension], dimension=dimension, file=named, name=named.removesuffix(".toml"))


def template_text(file: Path, template: str) -> tuple[str, str]:
    """The scene of a template that is written to a file, and the options with which it is run."""
    text = (TEMPLATES / f"{template}.toml").read_text(encoding="utf-8")
    options = text.splitlines()[0].partition(_SCENE_FILE)[2]
    return f"#:schema ./{SCHEMA.name}\n{text.replace(_SCENE_FILE, _printable(file.name), 1)}", options


def _printable(name: str) -> str:
    """A name as it may stand in a scene."""
    return "".join(letter if letter.isprintable() and letter not in '"\\' else "_" for letter in name)


def list_examples(names: list[str], folder: Path) -> str:
    """The examples, a line each; or, where some are named, these copied into a folder, which is made."""
    found = {path.stem: path for path in sorted(examples_folder().iterdir()) if path.suffix in (".toml", ".py")}
    if not found:
        raise InputError(f"{examples_folder()} holds no examples: install Cortado again.")
    if not names:
        return "\n".join([*map(_line, found.values()), "", "cortado examples --copy NAME copies one here, or all."])
    return _copied([found[name] for name in _chosen(names, list(found))], folder)


def _chosen(names: list[str], known: list[str]) -> list[str]:
    plain = [name.removesuffix(".toml").removesuffix(".py") for name in names]
    for name, given in zip(plain, names, strict=True):
        if name not in (*known, ALL):
            raise InputError(f"--copy is {shown(given)}, but must be {ALL} or one of {', '.join(known)}.")
    return known if ALL in plain else list(dict.fromkeys(plain))


def _copied(sources: list[Path], folder: Path) -> str:
    """Nothing is copied unless all of it can be: a file that is there is kept. What an example reads goes with it."""
    examples = [folder / source.name for source in sources]
    beside = (path for source in sources for path in sorted(source.parent.glob(f"{source.stem}_*")))
    sources = [*sources, *(path for path in beside if path.suffix in DATA)]
    targets = [folder / source.name for source in sources]
    for target in targets:
        if is_taken(target):
            raise InputError(f"{target} is already there; choose another folder with --to, or remove it.")
    with sentences(folder):
        folder.mkdir(parents=True, exist_ok=True)
    for source, target in zip(sources, targets, strict=True):
        write_atomically(target, source.read_bytes())
    return "" if is_quiet() else "\n".join(f"{example}: {_command(example)}" for example in examples)


def _command(path: Path) -> str:
    """How an example is run."""
    if path.suffix == ".py":
        return f"python {path}"
    tables = tomllib.loads(path.read_text("utf-8"))
    command = next((name for name in ("optimise", "fit", "dataset") if name in tables), "run")
    return f"cortado {command} {path}"


def _line(path: Path) -> str:
    """Its name and what it says of itself, first of all."""
    text = path.read_text("utf-8")
    if path.suffix == ".py":
        first = (ast.get_docstring(ast.parse(text)) or "").split("\n")[0]
    else:
        first = text.split("\n")[0].lstrip("# ")
    return textwrap.fill(first, 110, initial_indent=f"{path.name:<28}  ", subsequent_indent=" " * 30)
