"""The freeze: what Cortado computes and shows, as digests that a refactoring is held against.

    python tests/freeze.py                               # all of it against tests/data/freeze.json, within TOLERANCE
    python tests/freeze.py --write base.json             # at one commit; without a file, tests/data/freeze.json anew
    python tests/freeze.py --bits --compare base.json    # at another commit, on the same machine: the same bits?

`--only WORD` takes rows that have the word in their names, `--only texts` those without a simulation, and
`--processes 2` two cores.

A row is a scene in a precision: `STEPS` steps from first values with noise in them, so that all terms act. Its digests
are of the fields of the last state, of their tangents along one direction of all parameters, and of the gradient of a
sum of positions, velocities and mass fractions with random weights, times the size of a meaningful change of each
parameter. A digest is the beginning of the SHA-256 of the bytes, which is the same on one machine alone, and the norm,
the sum over the square root of how many they are, and a random projection, which are about the same on all machines.
Scenes are those that are shipped, the larger ones cut to some 500 particles by a coarser spacing (`SPACINGS`), and
small ones for what these lack (`own`). Texts are the help of every command, the public names with their signatures, and
the schema of scene and task files without its descriptions.
"""

import argparse
import contextlib
import inspect
import io
import json
import multiprocessing
import re
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from hashlib import sha256
from importlib.util import find_spec
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any
from zlib import crc32

import numpy as np
import warp as wp

import cortado
from compiling_notice import FLAGS
from cortado import Problem, Scene, Simulation, forces, gradients, load_scene
from cortado.certificate.horizon import directions, everything, scales
from cortado.cli import main
from cortado.cli.subcommands import CORTADO, new_scene, templates
from cortado.optimisation.task_tables import file_schema
from cortado.scene.parameters import Role
from scenes import CUBIC, jet, scene, two_layers
from scenes import plane as in_the_plane
from scenes import plane_of_three as of_three
from test_examples import FILES
from test_free_bodies import RAFT
from test_free_bodies import plane as with_bodies

DATA = Path(__file__).parent / "data" / "freeze.json"
STEPS = 20
TOLERANCE = {"float64": 1e-12, "float32": 1e-4}
"""Of the norm of a quantity, by which its numbers may differ from machine to machine. Kernels have the same bits on all
processors without fused multiplications, with which small scenes differ by 1e-13 and 3e-5; so do functions of NumPy."""
FLOOR = 1e-2
"""The norm of a gradient counts as this part of the greatest one of its row at least: some are mostly round-off."""
GROWING = {"baffles", "beach", "drop", "drop_large", "ink", "jug", "match_image", "materials", "pour", "rotor"}
GROWING |= {f"new {name}" for name in ("drop", "pillar", "pour", "raft", "rayleigh_taylor", "shaken", "stirred")}
GROWING |= {"new baffled_tank", "dam_break_large", "shaken"}
GROWING |= {f"{name} float32" for name in ("dam_break", "dam_break_dataset", "two_dams")}
"""Scenes, or rows of a precision, in which a last bit of NumPy's grows beyond that, as splashes do: they have their
numbers on one machine."""
MODULES = ("errors", "environments", "jax", "torch")
"""Public ones besides those among the names of `cortado`."""
SPACINGS = {
    name: spacing
    for spacing, names in {
        0.0025: ["surface_tension"],
        0.004: ["jug"],
        0.0045: ["honey", "latte_art_heart", "latte_art_large"],
        0.005: ["latte_art", "latte_art_small", "new honey", "pour"],
        0.0055: ["new pour"],
        0.0065: ["ring"],
        0.007: ["new stirred", "turned_cup"],
        0.01: ["rotor"],
        0.012: ["drop", "drop_large", "new drop"],
        0.015: ["fountain"],
        0.02: ["match_image", "materials"],
        0.025: ["new shaken", "shaken"],
        0.03: ["baffles"],
        0.04: ["ink", "match_image_fractions", "new rayleigh_taylor", "shear"],
        0.06: ["new baffled_tank"],
        0.07: ["beach"],
        0.08: ["dam_break", "new pillar", "new raft"],
        0.1: ["dam_break_large", "recover_gravity", "two_dams"],
        0.125: ["splash_8000"],
    }.items()
    for name in names
}
"""[m]"""
Make = Callable[[], Scene]
Table = dict[str, Any]


def drag(x, v, t, k):
    return -k * v


plane, plane_of_three = (partial(make, discretisation=CUBIC) for make in (in_the_plane, of_three))


def own() -> Iterator[tuple[str, Make, Table]]:
    """What no shipped scene has: a name, what makes the scene, and options of `digests`."""
    projection, pull = {"kind": "projection", "time_step": 0.002}, {"gravity": [0.0, -9.81]}
    held = {"shape": "box", "lower": [0.0, 0.0], "upper": [0.7, 0.8], "slip": "no"}
    for kernel, support in {"cubic_spline": 2.0, "wendland_c2": 2.6, "wendland_c4": 3.0}.items():
        cut = {"spacing": 0.05, "support": support, "kernel": kernel}
        yield f"projection {kernel}", partial(plane, discretisation=cut, solver=projection), {}
    for form in ("pairwise", "stress"):
        yield f"pcisph {form}", partial(plane, forces={**pull, "viscosity": form}, container=held), {}
    yielding, thinning = {"yield_stress": 5.0}, {"flow_index": 0.6}
    laws = {"bingham": yielding, "herschel_bulkley": yielding | thinning, "power_law": thinning}
    for law, keys in (laws | {"carreau": {**thinning, "relaxation_time": 0.5}}).items():
        mud = {"name": "water", "rest_density": 1300.0, "viscosity": 2.0, "rheology": {"kind": law, **keys}}
        yield law, partial(plane, phase=[mud], container=held, forces=pull, solver=projection), {}
    viscous = gradients.AdjointViscosity()
    yield "gradient AdjointViscosity", partial(plane, solver=projection), {"estimator": viscous}
    yield "gradient Tape", plane, {"estimator": gradients.Tape()}
    tension = {**pull, "surface_tension": 0.5}
    yield "pcisph tension", partial(plane, forces={**tension, "viscosity": "pairwise"}), {}
    yield "projection tension", partial(plane, forces=tension, solver=projection), {}
    yield "pcisph mixture", two_layers, {}
    yield "pcisph emitter", jet, {}
    wells = {"free_energy": "double_well", "mobility": 0.01, "interface_width": 0.1}
    yield "double well", partial(plane_of_three, mixture=wells), {}
    yield "periodic", partial(plane, container={**held, "periodic": [True, False]}, solver=projection), {}
    ball = {"name": "ball", "shape": "sphere", "centre": [0.52, 0.14], "radius": 0.08}
    arm = {**ball, "name": "arm", "centre": [0.7, 0.7], "motion": "path", "velocity": [0.0, -0.2]}
    yield "bodies", partial(with_bodies, RAFT, {**ball, "motion": "free", "density": 1200.0}, arm), {}
    yield "own force", partial(plane, solver=projection), {"forces": [forces.Body(drag, k=2.0)]}
    yield "batch", partial(plane_of_three, solver=projection), {"batch": 2}
    yield "batch in space", scene, {"batch": 2}


def shipped() -> Iterator[tuple[str, Make, Table]]:
    """Scenes that are shipped, and those that `cortado new` writes, in the same form."""
    for path in FILES:
        yield path.stem, partial(cut, path), {}
    for template, dimension in (("dam", 2), ("dam", 3), *((name, None) for name in templates()[1:])):
        yield f"new {template}{' in space' if dimension == 3 else ''}", partial(written, template, dimension), {}


def cut(path: Path, name: str = "") -> Scene:
    spacing = SPACINGS.get(name or path.stem)
    return load_scene(path, [] if spacing is None else [f"discretisation.spacing={spacing}"])


def written(template: str, dimension: int | None) -> Scene:
    with tempfile.TemporaryDirectory() as folder:
        new_scene(Path(folder, "scene.toml"), template, dimension)
        return cut(Path(folder, "scene.toml"), f"new {template}")


ROWS = {name: (make, options) for name, make, options in (*shipped(), *own())}


class Weighted:
    """A loss: fields of the state times random weights."""

    def weights(self, end: Any) -> Table:
        fields = ("positions", "velocities", "mass_fractions")
        return {name: _random(name).standard_normal(getattr(end, name).shape) for name in fields}

    def value(self, end: Any) -> float:
        return sum(float((weights * getattr(end, name)).sum()) for name, weights in self.weights(end).items())

    def value_and_adjoint(self, end: Any) -> tuple[float, Table]:
        return self.value(end), self.weights(end)


def _random(name: str) -> np.random.Generator:
    return np.random.default_rng(crc32(name.encode()))


def digest(array: Any) -> str:
    """Of the bits and of the numbers of an array, in words."""
    flat = np.ascontiguousarray(array).reshape(-1)
    numbers, weights = flat.astype(np.float64), _random("projection").standard_normal(flat.size)
    size, total = np.linalg.norm(numbers), numbers.sum() / max(flat.size, 1) ** 0.5
    along, digits = numbers @ weights / (np.linalg.norm(weights) or 1.0), 8 if flat.dtype == np.float32 else 15
    return " ".join((sha256(flat.tobytes()).hexdigest()[:12], *(f"{one:.{digits}g}" for one in (size, total, along))))


def digests(row: str, precision: str) -> dict[str, str]:
    """Of one row, by the names of the quantities."""
    wp.config.cpu_compiler_flags = FLAGS
    make, options = ROWS[row]
    batch, estimator = options.get("batch"), options.get("estimator", gradients.Exact())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        simulation = Simulation(make(), "cpu", precision, forces=options.get("forces", ()))
        problem = Problem(simulation, STEPS, Weighted())
        values = everything(problem, {})
        values = {name: value for name, value in values.items() if simulation.known[name].role is not Role.LOSS}
        if simulation.scene.solver.chooses and "nozzle.path" in values:
            values["nozzle.path"] = values["nozzle.path"][0]  # the only form that it may have there
        sizes = scales(problem, values)
        along = {name: directions({name: values[name]}, sizes, _random(name))[name] for name in values}
        for name in ("initial_positions", "initial_velocities"):
            moved = slice(simulation.free_particles)
            values[name] = values[name].copy()
            values[name][moved] += 0.4 * sizes[name][moved] * _random(f"first {name}").uniform(-1.0, 1.0)
        if batch:
            other = {n: v if n == "mass_fractions" else v + 0.3 * along[n] for n, v in values.items()}
            values = {name: np.stack([value, other[name]]) for name, value in values.items()}
            along, sizes = ({n: np.stack([v] * batch) for n, v in table.items()} for table in (along, sizes))
            problem = Problem(Simulation(make(), "cpu", precision, batch=batch), STEPS, Weighted())
        loss, gradient = problem.value_and_gradient(values, estimator)
        dots: Table = {}

        def observe(step: int, dot: Any) -> None:
            if step == STEPS:
                dots.update(dot.numpy(simulation.dimension))

        end = problem.tangents(values, along, observe, [STEPS])[STEPS].state.numpy(simulation.dimension)
    found = {f"last {name}": value for name, value in end.items()}
    found |= {f"tangent of {name}": value for name, value in dots.items()}
    found |= {f"gradient of {name}": value * sizes[name] for name, value in gradient.items()}
    return {"loss": digest(loss), **{name: digest(value) for name, value in found.items()}}


def helps() -> Iterator[tuple[str, list[str]]]:
    """What every command says of itself, an option on a line, however it is wrapped and framed."""
    left = [["cortado"]]
    while left:
        words, said = left.pop(0), io.StringIO()
        with contextlib.redirect_stdout(said), contextlib.suppress(SystemExit):
            main([*words[1:], "--help"], CORTADO)
        usage, _, rest = said.getvalue().partition("\n\n")
        left += [[*words, name] for group in re.findall(r"\{([\w,]+)\}$", usage) for name in group.split(",")]
        text = " ".join(re.sub("[\u2500-\u257f]|-{3,}", " ", rest).split())
        yield f"{' '.join(words)} --help", [" ".join(usage.split()), *re.split(r" (?=-\w, --|(?<!, )--\w|• )", text)]


def names() -> Iterator[tuple[str, list[str]]]:
    """The public names with their signatures, and those of the methods of classes, module by module. The modules that
    classes come from do not count."""
    inside = {name for name in cortado.__all__ if isinstance(getattr(cortado, name), ModuleType)}
    yield "cortado", list(_signatures(cortado))
    for module in sorted(inside | set(MODULES)):
        with contextlib.suppress(ImportError):  # of a library that is not installed
            yield f"cortado.{module}", list(_signatures(getattr(cortado, module)))


def _signatures(module: ModuleType) -> Iterator[str]:
    made_here = [name for name, one in vars(module).items() if getattr(one, "__module__", "") == module.__name__]
    for name in sorted(getattr(module, "__all__", made_here)):
        one = getattr(module, name)
        yield name + _signature(one)
        kinds = [kind for kind in getattr(one, "__mro__", ()) if kind.__module__.startswith("cortado")]
        for part in sorted({part for kind in kinds for part in vars(kind) if not part.startswith(("_", "model_"))}):
            found = inspect.getattr_static(one, part)
            yield f"{name}.{part}{_signature(getattr(found, '__func__', found))}"


def _signature(one: Any) -> str:
    if not callable(one) or hasattr(one, "model_fields"):  # those of tables are in the schema
        return ""
    if isinstance(one, type) and not any(isinstance(make, FunctionType) for make in (one.__init__, one.__new__)):
        return ""  # it is made as Python makes it, such as most exceptions
    words = str(inspect.signature(one))
    words = re.sub(r"(: |-> )'([^']*)'", r"\1\2", words)
    return re.sub(r"\b(cortado|numpy|collections|typing|pathlib|os)(\.\w+)*\.(?=\w)| at 0x\w+", "", words)


def schema() -> Iterator[tuple[str, list[str]]]:
    """Of scene and task files, a key and a digest of what it may be on a line, table by table: the words themselves are
    in `scene.schema.json`."""
    whole = _undescribed(file_schema())
    for name, table in {"the file": whole, **whole["$defs"]}.items():
        rest = {key: value for key, value in table.items() if key not in ("$defs", "properties")}
        keys = {**table.get("properties", {}), "": rest}
        words = {key: json.dumps(value, sort_keys=True).encode() for key, value in keys.items()}
        yield f"schema of {name}", [f"{key} {sha256(words[key]).hexdigest()[:12]}" for key in keys]


def _undescribed(value: Any) -> Any:
    if isinstance(value, list):
        return [_undescribed(one) for one in value]
    if not isinstance(value, dict):
        return value
    return {key: _undescribed(one) for key, one in value.items() if not (key == "description" and isinstance(one, str))}


def texts() -> dict[str, list[str]]:
    return dict((*helps(), *names(), *schema()))


def rows(only: str = "") -> list[tuple[str, str]]:
    return [(name, precision) for name in ROWS for precision in TOLERANCE if only in f"{name} {precision}"]


def frozen(only: str = "", processes: int = 1) -> dict[str, Any]:
    """All that `--write` writes, or what has a word in its name."""
    found: dict[str, Any] = {"texts": texts()} if only in "texts" else {}
    wanted = rows(only)
    if len(wanted) > processes > 1:
        with multiprocessing.get_context("spawn").Pool(processes) as pool:
            made = pool.starmap(digests, wanted, chunksize=1)
    else:
        made = [digests(*row) for row in wanted]
    return found | {" ".join(row): one for row, one in zip(wanted, made, strict=True)}


def differences(old: dict[str, Any], new: dict[str, Any], bits: bool = False) -> Iterator[str]:
    """A line for each difference of what `frozen` returned twice; of texts with the lines that only one has."""
    for name in sorted(old.keys() ^ new.keys()):
        yield f"{name}: only the {'new' if name in new else 'old'} one has it"
    for name in (name for name in old if name in new):
        if name == "texts":
            yield from differences(old[name], new[name])
        elif isinstance(old[name], list):
            alone = [f"\n  - {line}" for line in old[name] if line not in new[name]]
            alone += [f"\n  + {line}" for line in new[name] if line not in old[name]]
            if old[name] != new[name]:
                yield f"{name}:{''.join(alone) or ' another order'}"
        else:
            yield from _unequal(name, old[name], new[name], bits)


def _unequal(row: str, old: dict[str, str], new: dict[str, str], bits: bool) -> Iterator[str]:
    """Of one row, by its quantities."""
    greatest = max((_numbers(one)[0] for name, one in old.items() if name.startswith("gradient")), default=0.0)
    for name in sorted(old.keys() ^ new.keys()):
        yield f"{row}: {name}: only the {'new' if name in new else 'old'} one has it"
    for name in (name for name in old if name in new):
        floor = FLOOR * greatest if name.startswith("gradient") else 0.0
        one, other = _numbers(old[name]), _numbers(new[name])
        distance = float(np.abs(one - other).max() / (max(one[0], floor) or 1.0))
        if not distance <= TOLERANCE[row.split()[-1]] or (bits and old[name] != new[name]):
            yield f"{row}: {name}: other {'bits' if bits else 'numbers'}, a relative distance of {distance:.1e}"


def _numbers(words: str) -> np.ndarray:
    return np.array([float(word) for word in words.split()[1:]])


def command(arguments: list[str] | None = None) -> int:
    """Write or compare; 1 where something differs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", nargs="?", type=Path, const=DATA, help=f"the file to write, {DATA.name} if left out")
    parser.add_argument("--compare", type=Path, default=DATA, help="the file to compare with")
    parser.add_argument("--bits", action="store_true", help="compare bits, not only numbers")
    parser.add_argument("--only", default="", help="a word in the names of rows, or texts")
    parser.add_argument("--processes", type=int, default=1)
    given = parser.parse_args(arguments)
    if given.write and given.only in "texts" and find_spec("torch") is None:
        parser.error("PyTorch is not installed: the texts of cortado.torch would be lost")
    old = {} if given.write else json.loads(given.compare.read_text(encoding="utf-8"))
    old = {name: one for name, one in old.items() if given.only in name}
    new = frozen(given.only, given.processes)
    if given.write:
        kept = json.loads(given.write.read_text()) if given.only and given.write.exists() else {}
        given.write.write_text(json.dumps(kept | new, indent=0) + "\n", encoding="utf-8")
        print(f"{len(new)} rows in {given.write}")
        return 0
    found = list(differences(old, new, given.bits))
    print(*found, f"rows: {len(new)}, differences: {len(found)}", sep="\n")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(command())
