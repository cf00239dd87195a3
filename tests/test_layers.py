"""Data flows down one list: a module imports only from modules above it. And who may launch, and what stays light."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import cortado

ROOT = Path(cortado.__file__).parent

LAYERS = """
    errors words notebook threads files memory input_files arrays interruption terminal silence kernel_cache
    image_losses srgb
    smoothing calibration parameters.registry parameters.values parameters.tilt parameters.reference_density
    precision kernels physics.reduction launching cells
    physics.smoothing_functions physics.surroundings
    sph.integration sph.density physics.nozzle physics.free_energy physics.spreading physics.diffusion
    physics.mixture
    physics.adjoint_filters physics.containment physics.matching
    physics.tint physics.colour_field physics.interpolation physics.rays physics.absorption
    shapes region pairs walls.points walls.places walls.layers walls.weights walls
    restart neighbours particles
    render.cameras render.views render.fields render.marching render.renderer
    vtkhdf_layout vtkhdf
    scene_kinds scene_tables scene_toml point_reader scene_points
    scene_fluids scene_emitter scene_mixture scene_render scene_containers scene_stability scene_checks scene sampling
    discrete_scene
    sph.parts sph.pair_forces sph.gravity sph.viscosity sph.mixture sph.nozzle sph
    reference.digits reference.engine reference.losses reference.histories reference.simulation reference
    figures.canvas figures.particle_sets trajectory figures.curves
    solvers.containment solvers.solver
    solvers.pcisph.wall_relaxation solvers.pcisph.density_ratio_relaxation solvers.pcisph.pressure
    solvers.pcisph.frozen_pressure solvers.pcisph.convergence solvers.pcisph.parts solvers.pcisph.log
    solvers.pcisph.steps solvers.pcisph.derivatives solvers.pcisph.solver solvers.adjoint_filters
    rollout
    policies.policy policies.exact policies.strength policies.filters policies.cloud policies.ensemble policies
    losses checked_loss parameters.checks parameters.space parameters render.scene_renderer simulation problem
    reparametrisation
    evaluations optimisers named_optimisers differentiable optimisation_result optimisation
    folder_lock run_environment run_folder progress pictures video
    figures.side_by_side figures report
    task_tables task assignment task_figures
    certificate.twin certificate.course certificate.changes certificate.rightness certificate.horizon
    certificate.agreement certificate.text certificate.certificate certificate figures.gradient_check
    study.tables study.scenes study.experiment study.canvas study.comparison study.reference_losses study.sources
    study.gravity_tangents study.term_sizes
    study.estimates study.shades study.starts study.spatial_scales study.lyapunov_spectrum study.lyapunov_exponents
    study.one_kernel_loops
    study.* study.kinds study.experiment_files study.results
    commands.* usage cli __main__
"""
"""From the foundations to the command line; ``package.*`` stands for modules that do not import one another.

The package itself, ``cortado``, has no place in it: it imports nothing of its own before a name is used.
"""
ORDER = LAYERS.split()


def rank(module: str) -> int | None:
    """The place of a module in the list, None where it has none."""
    names = [module, f"{module.split('.')[0]}.*"]
    return next((ORDER.index(name) for name in names if name in ORDER), None)


def modules() -> dict[str, Path]:
    """Every module by its name within the package."""
    found = {}
    for path in sorted(ROOT.rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        if parts[-1] != "__init__":
            found[".".join(parts)] = path
    return found


def is_for_types_only(node: ast.AST) -> bool:
    """Whether this is ``if TYPE_CHECKING``."""
    return isinstance(node, ast.If) and ast.unparse(node.test) in ("TYPE_CHECKING", "typing.TYPE_CHECKING")


def statements(node: ast.AST):
    """Every node that can run, also inside functions."""
    for child in ast.iter_child_nodes(node):
        if is_for_types_only(child):
            for other in child.orelse:
                yield other
                yield from statements(other)
            continue
        yield child
        yield from statements(child)


def imports(source: str, module: str, known: set[str]) -> set[str]:
    """Modules of the package that a module's source imports, by their names within the package."""
    found = set()
    for node in statements(ast.parse(source)):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            package = ["cortado", *module.split(".")][: -node.level] if node.level else []
            base = ".".join(package + ([node.module] if node.module else []))
            names = [f"{base}.{alias.name}" for alias in node.names]
        else:
            continue
        for name in names:
            if name == "cortado" or not name.startswith("cortado."):
                continue
            inner = name.removeprefix("cortado.")
            parent = inner.rpartition(".")[0]
            found.add(inner if inner in known else parent or inner)
    return found


MODULES = modules()
FREE = {"__version__"}
"""Names of the package itself that any module may import."""


def complaints(module: str, source: str, known: set[str]) -> list[str]:
    """Sentences about the imports of a module that run the wrong way."""
    own = rank(module)
    if own is None:
        return [f"{module} is not in the list of modules: give it its place in ORDER."]
    found = []
    for other in sorted(imports(source, module, known) - FREE):
        place = rank(other)
        if place is None:
            found.append(f"{module} imports {other}, which is no module of ORDER (import a name from its own module).")
        elif other != module and place >= own:
            found.append(f"{module} imports {other}, which comes after it.")
    return found


@pytest.mark.parametrize("module", MODULES)
def test_imports_run_one_way(module):
    found = complaints(module, MODULES[module].read_text(), set(MODULES))
    assert not found, "\n".join(found)


def test_the_list_names_nothing_twice():
    assert len(set(ORDER)) == len(ORDER)


def test_the_list_names_only_what_there_is():
    packages = {".".join(path.parent.relative_to(ROOT).parts) for path in ROOT.rglob("*/__init__.py")}
    assert set(ORDER) <= {*MODULES, *packages, *(f"{package}.*" for package in packages)}


@pytest.mark.parametrize(
    "source",
    [
        "from cortado.problem import Problem",
        "from cortado import problem",
        "import cortado.problem",
        "from .. import problem",
        "from ..problem import Problem",
        "def f():\n    from cortado.problem import Problem",
        "if TYPE_CHECKING:\n    pass\nelse:\n    import cortado.problem",
        "from cortado import Problem",
    ],
)
def test_an_import_upwards_is_found(source):
    assert complaints("sph.density", source, {"problem", "sph.density"})


@pytest.mark.parametrize(
    "source",
    [
        "from cortado.errors import InputError",
        "from cortado import errors, __version__",
        "from ..errors import InputError",
        "from .integration import integration_module",
        "if TYPE_CHECKING:\n    from cortado.problem import Problem",
        "import numpy, warp as wp",
    ],
)
def test_an_import_downwards_is_allowed(source):
    assert not complaints("sph.density", source, {"errors", "problem", "sph.density", "sph.integration"})


def test_a_new_module_needs_a_place():
    assert complaints("somewhere", "", {"somewhere"})


def warp_names(path: Path) -> set[str]:
    """Names of Warp that a file uses: ``kernel`` for ``wp.kernel`` and for ``from warp import kernel``."""
    tree = ast.parse(path.read_text())
    found = {
        node.attr
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in ("wp", "warp")
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "warp":
            found |= {alias.name for alias in node.names}
    return found


LAUNCHES = {"launch", "launch_tiled"}


@pytest.mark.parametrize("module", sorted(MODULES.keys() - {"launching"}))
def test_kernels_are_launched_by_name(module):
    """`cortado.launching` binds arguments by their names and checks them; nobody goes around it."""
    assert not warp_names(MODULES[module]) & LAUNCHES


def test_there_is_a_launch_to_speak_of():
    assert "launch" in warp_names(MODULES["launching"])


def test_import_is_light():
    program = "import sys, cortado; print(*(n for n in ('warp', 'matplotlib', 'scipy') if n in sys.modules))"
    found = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout.split()
    assert not found, f"import cortado alone imports {', '.join(found)}"


WITHOUT_WARP = [
    "errors",
    "parameters.values",
    "smoothing",
    "calibration",
    "scene",
    "sampling",
    "discrete_scene",
    "reference",
]
"""What an engine without Warp stands on."""


@pytest.mark.parametrize("module", WITHOUT_WARP)
def test_the_discretisation_is_without_warp(module):
    program = f"import sys, cortado.{module}; print('warp' in sys.modules)"
    found = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout.split()
    assert found == ["False"], f"cortado.{module} imports Warp on the way"
