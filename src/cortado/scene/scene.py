"""Scenes, replacements of their values, and warnings about values in a wrong unit."""

import json
import os
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any, Self

import numpy as np
from pydantic import model_validator

from cortado.arrays import as_one_number
from cortado.calls import counted, point_in_words, public
from cortado.device.threads import require, sampling_parts
from cortado.errors import LONGEST, InputError, SceneError, Words, shown, warn
from cortado.files.disk import as_path, content, reason
from cortado.scene.checks import check_scene
from cortado.scene.model import OTHER_TABLES, SceneTables
from cortado.scene.restart import RestartState
from cortado.scene.scene_warnings import check_idle, creep_sentence, idle_sentences, viscosity_sentence
from cortado.scene.shape_tables import BoxContainer, CylinderContainer
from cortado.scene.stability import broken_limits, chosen_limits, longest_step
from cortado.scene.tables import MISSING, field_error, sentences


@public
class Scene(SceneTables):
    """A scene, from which a simulation starts.

    Arguments are the keys of a scene file. A table such as [discretisation] is a dict, and tables such as [[phase]] are
    a list of dicts. A missing or invalid value raises a `SceneError`. Scenes are immutable: `replaced` returns another
    scene, with all checks. Pydantic's ``model_copy(update=...)`` would skip the checks.

    Example::

        scene = cortado.Scene(
            dimension=2,
            discretisation={"spacing": 0.04},
            phase=[{"name": "water", "rest_density": 1000.0, "viscosity": 1.0}],
            fluid=[{"shape": "box", "lower": [0.0, 0.0], "upper": [0.4, 0.4], "phase": "water"}],
            container={"shape": "box", "lower": [0.0, 0.0], "upper": [0.8, 0.8]},
            solver={"time_step": 0.002},
        )
        thick = scene.replaced("phase.water.viscosity=5.0")
    """

    @model_validator(mode="after")
    def _check(self) -> Self:
        check_scene(self)
        check_idle(self)
        time_step = self.solver.time_step
        if time_step == "auto":
            if not np.isfinite(min(chosen_limits(self).values())):
                wanted = "given, as nothing else bounds the time step of this scene where the fluid rests"
                raise field_error(("solver", "greatest_time_step"), MISSING, wanted)
        elif broken := broken_limits(self, {}, time_step):
            name, limit = broken[0]
            found = f"solver.time_step is {time_step:g} s, but the limit of stability is about {limit:.3g} s"
            warn(f"{found}, which comes from {name}.")
        held = viscosity_sentence(self, 'slip is "no" at walls') if self.sticks else None
        for sentence in filter(None, (*_in_other_units(self), held, creep_sentence(self), *idle_sentences(self))):
            warn(sentence)
        return self

    def replaced(self, *overrides: str) -> "Scene":
        """Return the scene with new values: ``scene.replaced("solver.time_step=0.002", "phase.oil.viscosity=2")``.

        Overrides are written as for `load_scene`. A relative file name in an override starts at the current folder.
        Raises the same `SceneError` as `load_scene`.
        """
        return Scene.from_json(self.to_json(), overrides, "the scene")

    def lasting(self, time: float | None = None, steps: int | None = None) -> "Scene":
        """Return the scene with enough fluid in its emitters for ``time`` [s], or for ``steps`` steps.

        An emitter is unchanged if the scene gives the emitter's volume, if drains feed the emitter, or if the fluid
        column behind the opening is long enough. The scene is unchanged if all axes are periodic. Raises `InputError`
        if the particles would not fit into memory.
        """
        spacing = self.discretisation.spacing
        if steps is not None:
            time = steps * longest_step(self)
        if not self.emitter or time is None or (self.periods[1] > 0.0).all():
            return self
        if not as_one_number("time", time) < np.inf:
            raise InputError(f"time is {time:g}, but must be a number of seconds greater than 0.")
        lasting = tuple(emitter.lasting(time, spacing) for emitter in self.emitter)
        if all(new is old for new, old in zip(lasting, self.emitter, strict=True)):
            return self
        count = sum(emitter.count(spacing) for emitter in lasting)
        require(sampling_parts(count, 0.0), "take less time, or give the volume of each emitter")
        return self.model_copy(update={"emitter": lasting})

    def going_on(self, state: RestartState) -> "Scene":
        """Return the scene with at least as many particles in each emitter as in the run that computed ``state``."""
        origin, spacing, made = state.origin, self.discretisation.spacing, list(self.emitter)
        if origin is None or len(origin.waiting) != len(made):
            return self
        for k, (emitter, count) in enumerate(zip(self.emitter, origin.waiting, strict=True)):
            if emitter.volume is None and count > len(emitter.sample(spacing).upstream):
                made[k] = emitter.model_copy(update={"volume": count * spacing**self.dimension})
        return self.model_copy(update={"emitter": tuple(made)})

    def to_json(self) -> str:
        """Return the scene with its default values as JSON, which `from_json` reads."""
        return json.dumps(self.model_dump(mode="json"), indent=2)

    def computed_json(self) -> str:
        """Return as JSON only what determines the results of a simulation, without pictures, sensors and materials."""
        aside: dict[str, Any] = {"picture": True, "sensor": True}
        lists = ("force", "solid", "hinge", "spring", "emitter", "drain")
        aside |= {name: True for name in lists if not getattr(self, name)}
        aside |= {} if self.discretisation.jitter else {"discretisation": {"jitter"}}
        unused = set() if self.solver.chooses else {"courant", "greatest_time_step"}
        off = set() if getattr(self.solver, "velocities_follow", True) else {"velocities_follow"}
        endless = {"tolerance", "maximum_iterations"} if getattr(self.solver, "tolerance", 0.0) is None else set()
        aside["solver"] = unused | off | endless
        aside |= {name: {"__all__": {"material"}} for name in ("phase", "solid") if name not in aside}
        aside["container"] = {"material", "colour"}
        return json.dumps(self.model_dump(mode="json", exclude=aside, context="colours"), indent=2)

    @classmethod
    def from_json(cls, text: str | bytes, overrides: Sequence[str] = (), file: str = "scene.json") -> "Scene":
        """Read a scene from the JSON of `to_json`, with overrides as for `load_scene`. Error messages call the scene
        file ``file``."""
        if not isinstance(text, (str, bytes)):
            raise InputError(f"text is {shown(text)}, but must be the text that Scene.to_json gives.")
        try:
            data = json.loads(text)
        except (ValueError, RecursionError) as problem:
            raise SceneError(None, "", sentence=f"is not valid JSON: {problem}.") from None
        given = not isinstance(overrides, Sequence) or len(overrides) > 0
        if given and isinstance(data, dict):
            data = put_in(_given(data), overrides, file, OTHER_TABLES)
        return scene_from_dict(data)


def _in_other_units(scene: SceneTables) -> Iterator[str]:
    for phase in scene.phase:
        if phase.rest_density < 50.0:  # liquid hydrogen has 71 kg/m3, and mercury in g/cm3 would have 13.5
            found = f"the rest_density of {phase.name} is {phase.rest_density:g} kg/m3"
            yield f"{found}, less than any liquid has: is it in g/cm3?"
        if phase.viscosity > 1e4:
            yield f"the viscosity of {phase.name} is {phase.viscosity:g} Pa s, more than tar has: is it in mPa s?"
    for name, bodies in (("fluid", scene.fluid), ("solid", scene.solid)):
        for index, body in enumerate(bodies):
            turn = float(np.linalg.norm(getattr(body, "rotation", None) or 0.0))
            if turn > 2.0 * np.pi:
                yield f"{name}[{index}].rotation is {turn:g} rad, more than a whole turn: is it in degrees?"
    densities, spacing = {phase.name: phase.rest_density for phase in scene.phase}, scene.discretisation.spacing
    cells = sum(fluid.count(spacing) * densities[fluid.phase] for fluid in scene.fluid)
    mass, strength = cells * spacing**scene.dimension, np.linalg.norm(scene.forces.gravity)
    heaviest = {2: 3e5, 3: 3e6}[scene.dimension]  # kg: water of 30 m x 10 m, in space 10 m deep
    if mass >= heaviest and 0.1 < strength / 9.81 < 10.0:
        layer = " in a layer of 1 m" if scene.dimension == 2 else ""
        yield f"the fluid weighs about {mass:.2g} kg{layer}: are its lengths in millimetres? A scene has metres."


def _given(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _given(entry) for name, entry in value.items() if entry is not None}
    return [_given(entry) for entry in value] if isinstance(value, list) else value


@public
def load_scene(path: str | os.PathLike[str], overrides: Sequence[str] = ()) -> Scene:
    """Read a scene from a TOML file.

    Args:
        path: the scene file. Its tables [problem], [optimise] and [fit] are ignored.
        overrides: replacements such as ``solver.time_step=0.002`` or ``fluid[0].upper=[1,1,1]``.

    Raises:
        SceneError: the file is invalid. The message names the file, the field, the value found and the allowed values.

    Example: ``scene = cortado.load_scene("dam.toml", ["solver.time_step=0.001"])``
    """
    return scene_from_dict(read_toml(path, overrides, OTHER_TABLES), os.fspath(path))


def as_scene(scene: Scene | str | os.PathLike[str]) -> Scene:
    """Return a scene unchanged, or read the scene file at a path."""
    if isinstance(scene, Scene):
        return scene
    if isinstance(scene, (str, os.PathLike)):
        return load_scene(scene)
    raise InputError(f"scene is {shown(scene)}, but must be a cortado.Scene or the path of a scene file.")


def scene_from_dict(data: Mapping[str, Any], file: str | None = None) -> Scene:
    """Make a scene from the contents of its file. Relative paths in the scene start at the folder of ``file``."""
    if isinstance(data, Mapping):
        data = {key: value for key, value in data.items() if key not in OTHER_TABLES}
    folder = Path(file).parent if file else Path()
    try:
        with sentences(Scene):
            return Scene.model_validate(data, context={"folder": folder})
    except SceneError as error:
        raise (error.in_file(file) if file else error) from None


def files_named(tables: Mapping[str, Any]) -> list[tuple[dict[str, Any], str]]:
    """Return the tables that name a file, each with its key for the file. ``tables`` is a parsed `Scene.to_json`."""
    found = [*(tables.get("solid") or ()), *(tables.get("fluid") or ()), *(tables.get("schedule") or {}).values()]
    found += [one["path"] for one in tables.get("emitter") or ()]
    return [(table, key) for table in found if table for key in ("file", "path") if table.get(key)]


def scene_in_words(scene: Scene, particles: int) -> str:
    phases = [f"{phase.name} ({phase.rest_density:g} kg/m³, {phase.viscosity:g} Pa s)" for phase in scene.phase]
    changes = [
        f"{name.replace('_', ' ')} changes from {course.times[0]:g} s to {course.times[-1]:g} s"
        for name, course in scene.schedule.courses.items()
    ]
    container, held = scene.container, "in free space"
    if isinstance(container, CylinderContainer):
        held = f"in a cup of radius {container.radius:g} m and height {container.height:g} m"
    elif isinstance(container, BoxContainer):
        lengths = np.subtract(container.upper, container.lower)
        held = f"in a box of {' × '.join(f'{length:g}' for length in lengths)} m"
    emitter = f" of which {counted(len(scene.emitter), 'emitter')} give some," if scene.emitter else ""
    return (
        f"{counted(particles, 'particle')} of {' and '.join(phases)} in {scene.dimension}-D,{emitter} "
        f"{scene.discretisation.spacing:g} m apart at rest, {held}, under gravity "
        f"{point_in_words(scene.forces.gravity)} m/s²{'; its ' if changes else ''}{' and '.join(changes)}."
    )


MOST_BYTES = 1_000_000
"""Greatest size of a scene file [byte]."""
MOST_PARTS = 10
"""Greatest number of parts of a dotted key."""
_ASIDE = re.compile(
    r'''#[^\n]*|"""(?:[^"\\]|\\.|"(?!""))*+(?:"{3,5}|\Z)|"(?:[^"\\\n]|\\.)*+"?'''
    r"""|'{3}(?:[^']|'(?!''))*+(?:'{3,5}|\Z)|'[^'\n]*+'?""",
    re.DOTALL,
)
_TOO_DEEP = re.compile(rf"(?<![\w-])(?:[\w-]++[ \t]*+\.[ \t]*+){{{MOST_PARTS}}}[\w-]++")
_TWICE = re.compile(r"Cannot declare \('(fluid|phase)',\) twice")
_KEY = re.compile(r"[A-Za-z0-9_-]+(\[\d+\])*(\.[A-Za-z0-9_-]+(\[\d+\])*)*")


def read_toml(
    path: str | os.PathLike[str], overrides: Sequence[str] = (), unread: Sequence[str] = ()
) -> dict[str, Any]:
    """Read a TOML file and return its contents with overrides applied. Raises `SceneError` if the file or an override
    is invalid. Tables in ``unread`` cannot be overridden.

    An override is ``key=value``, such as ``forces.gravity=[0,-5,0]``, ``fluid.0.upper=[1,1,1]`` or
    ``fluid[0].upper=[1,1,1]``. An entry of a list can be given by the entry's name in place of the entry's index:
    ``phase.oil.viscosity=0.1``. A value that is not valid TOML is read as text.
    """
    file = as_path("path", path)
    try:
        text = content(path, MOST_BYTES).decode("utf-8-sig")
        _require_shallow(text, file)
        data = tomllib.loads(text)
    except UnicodeDecodeError as problem:
        line = problem.object[: problem.start].count(b"\n") + 1
        raise SceneError(file, "", sentence=f"is not text in UTF-8 (at line {line}).") from None
    except (ValueError, RecursionError) as problem:  # among them TOMLDecodeError, which names the line
        problem.__traceback__ = None  # it may have a thousand frames, too many to be pickled where a library does so
        if file.endswith(".json"):
            sentence = "is not TOML: Scene.from_json reads what Scene.to_json wrote."
            raise SceneError(file, "", sentence=sentence) from None
        said = _TWICE.sub(r"\g<0>; entries of a list are written [[\1]]", reason(problem))
        raise SceneError(file, "", sentence=f"is not valid TOML: {said}.") from None
    except OSError as problem:
        beside = _beside(file) if isinstance(problem, FileNotFoundError) else None
        there = f"; did you mean {beside}?" if beside else "."
        raise SceneError(file, "", sentence=f"cannot be read: {reason(problem)}{there}") from None
    return put_in(data, overrides, file, unread)


def overrides_of(overrides: Sequence[str], tables: Sequence[str]) -> list[str]:
    return [one for one in overrides if isinstance(one, str) and _table_of(one) in tables]


def _table_of(override: str) -> str:
    return re.split(r"[.\[=\s]", override.strip())[0]


def _beside(file: str) -> str | None:
    folder, name = os.path.split(file)
    try:
        names = [one for one in os.listdir(folder or ".") if one.endswith(".toml")]
    except OSError:
        return None
    close = [f"{name}.toml"] if f"{name}.toml" in names else get_close_matches(name, names, 1, cutoff=0.8)
    return os.path.join(folder, close[0]) if close else None


def put_in(data: dict[str, Any], overrides: Sequence[str], file: str, unread: Sequence[str] = ()) -> dict[str, Any]:
    if isinstance(overrides, str):
        sentence = f"must be in a list, as [{shown(overrides)}], as there may be several overrides."
        raise SceneError(file, shown(overrides), sentence=sentence)
    if not isinstance(overrides, Sequence):
        raise InputError(f"overrides is {shown(overrides)}, but must be a list of texts such as 'solver.kind=pcisph'.")
    for idle in overrides_of(overrides, unread):
        key, table = idle.partition("=")[0].strip(), _table_of(idle)
        raise SceneError(file, key, Words("given"), f"left out, as the table [{table}] is not used here")
    for override in overrides:
        if not isinstance(override, str):
            sentence = "is no override, which is a text such as 'solver.time_step=0.002'."
            raise SceneError(file, shown(override), sentence=sentence)
        _apply(data, override, file)
    return data


def _require_shallow(text: str, file: str) -> None:
    """Raise `SceneError` for a dotted key with too many parts. Call this function before the parser."""
    plain = _ASIDE.sub(lambda found: "" if found[0].startswith("#") else "text", text)
    if deep := _TOO_DEEP.search(plain):
        raise _too_deep(file, deep[0])


def _too_deep(file: str, key: str) -> SceneError:
    return SceneError(
        file, "", sentence=f"has a key of more than {MOST_PARTS} parts, {shown(key)}, but no table lies that deep."
    )


def _apply(data: dict[str, Any], override: str, file: str) -> None:
    if len(override) > MOST_BYTES:
        sentence = f"is the beginning of {len(override)} characters, but an override must have at most {MOST_BYTES}."
        raise SceneError(file, shown(override), sentence=sentence)
    _require_shallow(override, file)
    key, equals, text = map(str.strip, override.partition("="))
    if not equals or not _KEY.fullmatch(key):
        raise SceneError(file, shown(override), sentence="is not an override of the form key=value.")
    parts = key.replace("[", ".").replace("]", "").split(".")
    if len(parts) > MOST_PARTS:
        raise _too_deep(file, key)
    try:
        parsed = tomllib.loads(f"value = {text}")
    except (ValueError, RecursionError):
        parsed = {}
    place: Any = data
    for depth, part in enumerate(parts):
        index: Any = _entry(place, part) if isinstance(place, list) else part
        if index is None:
            found, wanted = _names(place), f"an index from 0 to {len(place) - 1}"
            wanted = f"{wanted}, or the name {' or '.join(found)}" if found else wanted
            wanted = wanted if place else "left out, as the list is empty"
            raise SceneError(file, _short(".".join(parts[: depth + 1])), part, wanted)
        if not isinstance(place, (dict, list)):
            sentence = f"cannot be set, as {'.'.join(parts[:depth])[:LONGEST]} is not a table."
            raise SceneError(file, _short(key), sentence=sentence)
        if depth == len(parts) - 1:
            place[index] = parsed["value"] if parsed.keys() == {"value"} else text
        else:
            place = place[index] if isinstance(place, list) else place.setdefault(part, {})


def _short(key: str) -> str:
    return key if len(key) <= LONGEST else shown(key)


def _entry(tables: list[Any], part: str) -> int | None:
    if part.isdecimal():
        return int(part) if len(part) <= 9 and int(part) < len(tables) else None
    return next((k for k, table in enumerate(tables) if part in _names([table])), None)


def _names(tables: list[Any]) -> list[str]:
    found = (table.get("name", table.get("kind")) for table in tables if isinstance(table, dict))
    return [str(name) for name in found if name is not None]
