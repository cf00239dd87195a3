"""A copy of the package in which the sign of any one term of any adjoint can be flipped while it runs.

Every term is multiplied by ``_sign(number)``, which is -1 for the one number that stands at a fixed address in memory,
and 1 for all others: kernels are compiled once for all plants. `plant_all` writes the copy; this file as a program,
with the copy on the path, says for every plant which scene gives it away.
"""

import ast
import ctypes
import json
import mmap
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from unittest.mock import patch

ADDRESS, NO_PLANT = 0x5000_0000_0000, -1
MODULE = f'''"""The sign of a term, flipped where its number is the one in memory."""

import ctypes

import warp as wp


@wp.func_native("return *((volatile int*){ADDRESS}) == number ? -1.0 : 1.0;")
def sign(number: int) -> wp.float64: ...


def host_sign(number: int) -> float:
    return -1.0 if ctypes.c_int.from_address({ADDRESS}).value == number else 1.0
'''
IMPORTS = {True: "from cortado.planted import sign as _sign", False: "from cortado.planted import host_sign as _sign"}
WHOLE_NUMBERS = {"i", "j", "b", "last", "member", "pixel", "row", "column"}
"""Variables that are indices."""
POSE = {"absorption_kernels.march_adjoint": {"push", "turn", "pose_bar"}}
"""Not planted: a camera's pose is no parameter of a problem (its derivatives: tests/test_render.py)."""
CONSTANTS = ("real(0.0)", "real(0.5)", "real(1.0)", "vector()")
"""Not planted: 0 and 1, and the derivative at the corner of mu_ij, where both viscosities are 0 and none is moved."""
UNSEEN = {
    "residual_kernels.residual_adjoint": {"b", "d_i", "bend", "bend * (d_i - b) * r_bar_i"},
    "rotations.further": {"square / real(24.0)", "square * square / real(720.0)"},
}
"""Not planted: what counts on a corner that is 1e-6 wide (tests/test_sheets.py), and terms of a series below 1e-4."""
STEPS = 3
"""Of the runs that are judged."""
WHOLE = 40
"""Of the plants that are found, one in so many has its certificate made to the end."""


def kernels_of_both_ways(cases) -> dict[str, list[str]]:
    """Keys of the kernels that problems launch at points: in runs "forward", and "backward"."""
    from cortado.device.launching import KernelLauncher
    from cortado.rollout.rollout import Rollout

    seen: dict[str, set[str]] = {"forward": set(), "backward": set()}
    launch, back, way = KernelLauncher.__call__, Rollout.backward, ["forward"]

    def keep(self, kernel, *arguments, **options):
        seen[way[0]].add(kernel.key)
        launch(self, kernel, *arguments, **options)

    def backward(*arguments, **options):
        way[0] = "backward"
        found = back(*arguments, **options)
        way[0] = "forward"
        return found

    with patch.object(KernelLauncher, "__call__", keep), patch.object(Rollout, "backward", backward):
        for problem, point in cases:
            problem.value_and_gradient({**problem.simulation.parameters(), **point})
    return {name: sorted(keys) for name, keys in seen.items()}


class Planter(ast.NodeTransformer):
    """Wraps the terms of functions of these names, and lists them."""

    def __init__(self, names: set[str], first: int):
        self.names, self.first = names, first
        self.found: list[tuple[str, str]] = []
        """Function and term, one for each plant."""
        self._outer: list[str] = []
        self._function = ""

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.AST:
        self._outer.append(node.name)
        name = ".".join(self._outer)
        self._function = name if name in self.names else ""
        node.body = [self.visit(statement) for statement in node.body]
        self._outer.pop()
        self._function = ""
        return node

    def visit_If(self, node: ast.If | ast.For) -> ast.AST:
        if not self._function:
            return self.generic_visit(node)
        node.body, node.orelse = ([self.visit(one) for one in part] for part in (node.body, node.orelse))
        return node

    visit_For = visit_If

    def visit_Assign(self, node: ast.Assign) -> ast.AST:
        target = node.targets[0]
        if self._function and _name(target) not in WHOLE_NUMBERS | POSE.get(self._function, set()):
            node.value = self._terms(node.value, isinstance(target, ast.Subscript), ast.unparse(target))
        return node

    def visit_AugAssign(self, node: ast.AugAssign) -> ast.AST:
        if self._function and _name(node.target) not in POSE.get(self._function, set()):
            node.value = self._terms(node.value, True)
        return node

    def visit_Return(self, node: ast.Return) -> ast.AST:
        if self._function and isinstance(node.value, ast.Tuple):
            node.value.elts = [self._terms(element, not isinstance(element, ast.Name)) for element in node.value.elts]
        elif self._function and node.value is not None:
            node.value = self._terms(node.value, True)
        return node

    def _terms(self, node: ast.expr, whole: bool, target: str = "") -> ast.expr:
        """With every operand of a sum wrapped, and a value that is no sum if it is ``whole``."""
        if isinstance(node, ast.BinOp) and isinstance(node.op, (ast.Add, ast.Sub)):
            node.left, node.right = self._terms(node.left, True, target), self._terms(node.right, True, target)
            return node
        if ast.unparse(node) in (target, *CONSTANTS, *UNSEEN.get(self._function, ())):
            return node
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "vector":
            node.args = [self._terms(argument, True) for argument in node.args]
            return node
        text = ast.unparse(node)
        node = self._inside(node)
        return self._wrapped(node, text) if whole else node

    def _inside(self, node: ast.expr) -> ast.expr:
        """With the sums within a product or a function's arguments planted; what is divided by has no sign to lose."""
        if isinstance(node, ast.BinOp):
            node.left = self._terms(node.left, False)
            node.right = node.right if isinstance(node.op, ast.Div) else self._terms(node.right, False)
        elif isinstance(node, ast.UnaryOp):
            node.operand = self._terms(node.operand, False)
        elif isinstance(node, ast.Call) and ast.unparse(node.func) != "real":
            node.args = [self._terms(argument, False) for argument in node.args]
        return node

    def _wrapped(self, node: ast.expr, text: str) -> ast.expr:
        number = self.first + len(self.found)
        self.found.append((self._function, text))
        return ast.BinOp(ast.parse(f"_sign({number})", mode="eval").body, ast.Mult(), node)


def qualified(node: ast.AST, outer: str = "") -> Iterator[tuple[str, ast.FunctionDef]]:
    """All functions below a node by their names, with those around them; without methods, which define no terms."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.FunctionDef):
            yield outer + child.name, child
            yield from qualified(child, f"{outer}{child.name}.")
        elif not isinstance(child, ast.ClassDef):
            yield from qualified(child, outer)


def adjoints(package: Path) -> dict[str, set[str]]:
    """Functions by module that have the word adjoint in their name, without those that only make such functions."""
    found: dict[str, set[str]] = {}
    texts = {path: path.read_text() for path in sorted(package.rglob("*.py"))}
    for path in (path for path, text in texts.items() if "adjoint" in text):
        for name, function in qualified(ast.parse(texts[path])):
            maker = any(isinstance(statement, ast.FunctionDef) for statement in function.body)
            if "adjoint" in function.name.split("_") and not maker:
                found.setdefault(".".join(path.relative_to(package).with_suffix("").parts), set()).add(name)
    return found


def _name(target: ast.expr) -> str:
    """Of the variable or the array that is assigned to."""
    return ast.unparse(target.value if isinstance(target, ast.Subscript) else target)


def plant_all(package: Path, copy: Path, functions: dict[str, set[str]]) -> list[tuple[str, str, str]]:
    """Copy the package with terms wrapped in functions of modules; (module, function, term) of every plant."""
    shutil.copytree(package, copy / "cortado", ignore=shutil.ignore_patterns("__pycache__"))
    (copy / "cortado" / "planted.py").write_text(MODULE)
    plants: list[tuple[str, str, str]] = []
    for module, names in functions.items():
        path = copy / "cortado" / (module.replace(".", "/") + ".py")
        tree = ast.parse(path.read_text())
        planter = Planter(names, len(plants))
        tree = planter.visit(tree)
        future = sum(isinstance(node, ast.ImportFrom) and node.module == "__future__" for node in tree.body)
        tree.body.insert(1 + future, ast.parse(IMPORTS["import warp as wp" in path.read_text()]).body[0])
        path.write_text(ast.unparse(ast.fix_missing_locations(tree)))
        plants += [(module, *one) for one in planter.found]
    return plants


# ---- in the copy -------------------------------------------------------------------------------------------------
def map_address() -> None:
    """From now on there is memory at `ADDRESS`."""
    libc = ctypes.CDLL(None, use_errno=True)
    libc.mmap.restype, libc.mmap.argtypes = ctypes.c_void_p, [ctypes.c_void_p, ctypes.c_size_t, *[ctypes.c_int] * 4]
    protection, fixed = mmap.PROT_READ | mmap.PROT_WRITE, 0x10
    flags = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | fixed
    assert libc.mmap(ADDRESS, mmap.PAGESIZE, protection, flags, -1, 0) == ADDRESS


def cases_of(scenes: dict[str, dict], precision: str) -> dict[str, tuple]:
    """Problems and points of scenes, by their names."""
    import cortado

    return {name: case(cortado.Scene(**one["scene"]), one["loss"], precision) for name, one in scenes.items()}


def alarms(cases: dict[str, tuple]) -> list[str]:
    """Names of those whose certificate is "wrong" without a plant."""
    import cortado

    return [name for name, one in cases.items() if not (cortado.certify(*one).right and is_right(*one))]


def judge(plants: list[int], cases: dict[str, tuple]) -> dict[str, str | None]:
    """For every plant a scene, of cases by name, whose certificate is "wrong"; None where none is."""
    import cortado

    number = ctypes.c_int.from_address(ADDRESS)
    found: dict[str, str | None] = {}
    order = list(cases)  # the one that caught the last plant comes first
    for k, plant in enumerate(plants):
        number.value = plant
        caught = next((name for name in order if not is_right(*cases[name])), None)
        found[str(plant)] = caught
        order.sort(key=lambda name: name != caught)
        if caught is not None and k % WHOLE == 0:
            assert not cortado.certify(*cases[caught]).right, f"found by a part of a certificate: {plant}"
    number.value = NO_PLANT
    return found


class Verdict(Exception):
    """Ends a certificate that is being made."""


TWINS: dict = {}
"""Problems in float64 by those that are certified."""


def is_right(problem, point) -> bool:
    """What `cortado.certify` says, of which no more is made than the verdict takes: neither which parameters are wrong
    if the check of all together has failed, and on a corner that beside it, nor how long a right gradient is useful; a
    problem in float32 is made in float64 but once."""
    from unittest.mock import patch

    import numpy as np

    import cortado.certificate.certificate as certificate

    if problem not in TWINS:
        TWINS[problem] = certificate.in_float64(problem)
    check, judge_all = certificate.check_consistency, certificate._consistency

    corners = []

    def first_check(history, values, gradient, along):
        found = check(history, values, gradient, along)
        if not found.right and found.is_on_a_corner and not corners:
            corners.append(found)
            return certificate._beside(history, values, along, np.random.default_rng(0))
        if not found.right:
            raise Verdict(False)
        return found

    def end(*arguments):
        _, wrong = judge_all(*arguments)
        raise Verdict(not wrong)

    changed = {"in_float64": TWINS.get, "check_consistency": first_check, "_consistency": end}
    try:
        with patch.multiple(certificate, **changed):
            certificate.certify(problem, point)
    except Verdict as verdict:
        return verdict.args[0]
    raise AssertionError("certificates are made in another way: nothing was checked")


def case(scene, loss: str, precision: str = "float64"):
    """A problem of a few steps, and a point at which nothing is symmetric, at rest or pure."""
    import numpy as np

    from cortado import Problem, Simulation, losses
    from cortado.image_losses import Pyramid, SquaredDifference
    from cortado.render.renderer import scene_renderer

    simulation, random = Simulation(scene, precision=precision), np.random.default_rng(1)
    spacing, sheets = scene.discretisation.spacing, any(solid.shape == "sheet" for solid in scene.solid)
    speed = 80.0 if sheets else 0.3  # at which sheets keep particles on their side, and leave some where they were
    shape, phases = simulation.positions.shape, len(scene.phase)
    point = {
        "initial_positions": simulation.positions + 0.03 * spacing * random.standard_normal(shape),
        "initial_velocities": simulation.velocities + speed * random.standard_normal(shape),
    }
    if phases > 1:
        fractions = 0.2 + random.random((shape[0], phases))
        point["mass_fractions"] = fractions / fractions.sum(axis=1, keepdims=True)
    for solid in (one for one in scene.solid if one.motion != "fixed"):  # what is free begins as it touches others
        angles = () if shape[1] == 2 else (3,)
        free = solid.motion == "free"
        begun = np.reshape(solid.rotation, angles) if free and solid.rotation else 0.0 if free else 0.3
        point[f"{solid.name}.rotation"] = begun + (0.001 if free else 0.1) * random.standard_normal(angles)
    if scene.emitter:
        point["nozzle.path"] = scene.emitter[0].outlet + 0.1 * spacing * random.standard_normal((STEPS, shape[1]))
    target = simulation.positions + 0.1 * random.standard_normal(shape)
    if loss == "positions":
        made = losses.FinalPositions(target)
    elif loss == "everything":
        made = Everything(target, random.standard_normal(phases))
    else:
        renderer, distances = scene_renderer(simulation), {"squares": SquaredDifference, "pyramid": Pyramid}
        made = losses.Image(renderer, random.random(renderer.shape), distances[loss]())
    return Problem(simulation, STEPS, made), point


class Everything:
    """A loss of positions, velocities and fractions."""

    def __init__(self, target, weights):
        self.target, self.weights = target, weights

    def value(self, end) -> float:
        c = (end.mass_fractions**2 @ self.weights).mean()
        return float(((end.positions - self.target) ** 2).mean() + 0.01 * (end.velocities**2).mean() + 0.01 * c)

    def adjoint(self, end):
        x, v, c = end.positions - self.target, end.velocities, end.mass_fractions
        return 2.0 / x.size * x, 0.02 / v.size * v, 0.02 / len(c) * c * self.weights


if __name__ == "__main__":
    import warp as wp

    wp.config.log_level = wp.LOG_ERROR
    request = json.loads(Path(sys.argv[1]).read_text())
    import cortado

    assert Path(cortado.__file__).is_relative_to(Path(sys.argv[1]).parent), "this is not the copy"
    map_address()
    ctypes.c_int.from_address(ADDRESS).value = NO_PLANT
    cases = {precision: cases_of(request["scenes"], precision) for precision in request["plants"]}
    launched = kernels_of_both_ways(cases["float64"].values())
    wrong = {precision: alarms(own) for precision, own in cases.items()}
    found = {precision: judge(plants, cases[precision]) for precision, plants in request["plants"].items()}
    Path(sys.argv[2]).write_text(json.dumps({"found": found, "alarms": wrong, "launched": launched}))
