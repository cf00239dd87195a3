"""Data flows down one list: a module imports only from modules above it. And who may launch, and what stays light."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import cortado

ROOT = Path(cortado.__file__).parent

LAYERS = """
    lazy
    errors
    fixed
    words
    arrays
    quantities quantities.known
    restart
    io io.file_lock io.files io.folder_lock io.input_files io.interruption io.terminal io.progress
    io.run_environment io.shipped io.srgb io.particle_view io.notebook io.usage io.video io.vtkhdf_layout io.vtkhdf
    lattice lattice.shapes lattice.pairs lattice.region lattice.smoothing lattice.calibration
    parameters parameters.reference_density parameters.registry parameters.known parameters.table
    parameters.tilt parameters.values
    scene scene.fields scene.sentences scene.point_reader scene.points scene.tables
    scene.schedule scene.fluids scene.emitter
    scene.mixture scene.picture scene.sensors scene.render scene.toml
    discretise discretise.walls discretise.walls.layers discretise.walls.points discretise.walls.places
    discretise.walls.weights
    scene.containers scene.entry_points scene.package_tables scene.solvers scene.model scene.stability
    device device.cores device.driver device.bundles device.binding device.kernels device.memory device.precision
    device.arithmetic device.loads device.lanes device.reduction device.host device.silence device.threads
    device.compiling device.kernel_cache
    device.smoothing
    device.neighbourhood device.terms device.pair_loops device.pair_sums device.made_derivatives device.by_hand
    device.arrays device.fields device.launching device.state device.cells
    device.candidates device.neighbours
    scene.overlaps scene.checks scene.scene scene.in_words
    discretise.crowding parameters.checks
    discretise.bodies discretise.packing discretise.sampling discretise.discrete_scene
    discretise.distance
    sph sph.density sph.free_energy sph.substeps sph.integration sph.begin_adjoint sph.order sph.materials
    sph.emitter_kernels sph.pair_forces sph.vorticity sph.wall_slope
    sph.pairwise_laplacian sph.surface_normals sph.surface_stress sph.diffusion sph.parts sph.carried sph.part
    sph.emitter sph.gravity sph.makers sph.mixture sph.surface_tension sph.viscosity
    sph.function_text sph.formula sph.packed sph.formula_kernels sph.own_force sph.body sph.pair forces
    solvers solvers.containment_kernels solvers.containment solvers.solver solvers.makers solvers.named
    solvers.convergence solvers.loop solvers.particles solvers.particle_derivatives solvers.build solvers.pcisph
    solvers.pcisph.begin_adjoint solvers.pcisph.density_ratio_relaxation
    solvers.pcisph.pressure solvers.pcisph.pressure_force solvers.pcisph.frozen_pressure
    solvers.pcisph.wall_relaxation solvers.pcisph.parts solvers.pcisph.steps solvers.pcisph.derivatives
    solvers.pcisph.solver solvers.pcisph.build
    reference.digits reference.engine reference.histories reference.losses reference.simulation reference
    executors.executor executors.calls executors.distributed executors.worker_process executors.local executors
    checkpoints evaluation rollout residual
    parameters.scene_parameters parameters.first_positions parameters.restarts parameters.space
    quantities.moment quantities.formulas quantities.evaluator quantities.recorder
    sensors.sensor sensors.flow_rate sensors.log sensors.pressure_probe sensors.wall_force sensors.wave_gauge
    sensors.of_scene sensors
    losses.image_losses losses.loss losses.batch losses.centre_of_mass losses.image losses.matching
    losses.positions losses.recorded losses.series losses losses.checked image_losses
    gradients.estimator gradients.points gradients.ensemble_members gradients.exact
    gradients.filter_kernels gradients.adjoint_filters gradients.filters gradients.left_out gradients.ensemble
    gradients.guided gradients
    render.cameras render.colour_field render.interpolation render.phase_colours render.fields render.rays
    render.absorption render.views render.marching render.renderer render.scene_renderer render
    io.pictures pictures
    figures.canvas figures.panels figures.particle_sets figures.side_by_side
    io.frame_file io.trajectory io.trajectory_batch
    shading shading.surface shading.stage shading.shadow shading.surroundings shading.glass shading.meeting
    shading.scenery shading.trace shading.space shading.plane
    shading.painter shading.page shading.labels shading.scale shading.film shading.scene_view
    outcome
    recorded
    host_states device_states stepper stepping measuring picturing watching
    simulation
    forward_pass
    problem
    figures.curves figures.readings figures
    certificate.growth certificate.alignment certificate.perturbations certificate.twin certificate.loss_history
    certificate.horizon
    certificate.consistency certificate.text certificate.certificate certificate certificate.figure
    optimisation optimisation.evaluate optimisation.differentiable optimisation.replay_log optimisation.search
    optimisation.iterate optimisation.line_search optimisation.optimisers
    optimisation.named_optimisers optimisation.result_page optimisation.result
    optimisation.start optimisation.evaluator optimisation.optimise
    optimisation.transforms optimisers
    io.run_folder io.report
    inverse inverse.tables inverse.file_schema inverse.task inverse.in_words inverse.setup inverse.knots
    inverse.chapters inverse.figures inverse.shaded
    study study.canvas study.comparison study.estimates study.lyapunov_spectrum study.one_kernel_loops
    study.reference_losses study.scenes study.palette study.sources study.gravity_tangents study.spatial_scales
    study.ensembles study.tables study.experiment study.forces study.gravity_and_precision study.image_horizon
    study.locality study.lyapunov_exponents study.lyapunov study.results study.round_off study.step_size study.task
    study.term_sizes study.pressure_terms study.wrong_adjoints study.wrong_derivation study.registry
    study.experiment_files
    bench bench.scene bench.timing bench.floor bench.passes bench.memory bench.dam_break bench.environment
    bench.reference_engine bench.text
    sweep sweep.combinations sweep.table
    commands commands.executor commands.found commands.bench commands.check commands.compare commands.describe
    commands.examples commands.figure commands.new commands.verdict commands.optimise_report commands.optimise
    commands.overview commands.picture
    commands.run_summary commands.run_report commands.run
    commands.schema commands.study
    commands.sweep commands.view_door commands.view_messages commands.view_server commands.view_window
    commands.view_quantities commands.view_recorded commands.view_live commands.view_task commands.view
    cli.command cli.arguments cli.parsing cli.shortage cli.gradient_commands cli.commands cli.process cli
    __main__
"""
"""From the foundations to the command line; ``package.*`` stands for modules that do not import one another.

The package itself, ``cortado``, has no place in it: it imports only ``lazy`` before a name is used.
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


def imports(source: str, module: str, known: set[str]) -> set[str]:
    """Modules of the package that a module's source imports, by their names within the package."""
    found = set()
    for node in ast.walk(ast.parse(source)):
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
        "if TYPE_CHECKING:\n    from cortado.problem import Problem",
        "if TYPE_CHECKING:\n    pass\nelse:\n    import cortado.problem",
        "from cortado import Problem",
    ],
)
def test_an_import_upwards_is_found(source):
    assert complaints("sph.viscosity", source, {"problem", "sph.viscosity"})


@pytest.mark.parametrize(
    "source",
    [
        "from cortado.errors import InputError",
        "from cortado import errors, __version__",
        "from ..errors import InputError",
        "from .pair_forces import PairForm",
        "import numpy, warp as wp",
    ],
)
def test_an_import_downwards_is_allowed(source):
    assert not complaints("sph.viscosity", source, {"errors", "problem", "sph.viscosity", "sph.pair_forces"})


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


@pytest.mark.parametrize("module", sorted(MODULES.keys() - {"device.launching"}))
def test_kernels_are_launched_by_name(module):
    """`cortado.device.launching` binds arguments by their names and checks them; nobody goes around it."""
    assert not warp_names(MODULES[module]) & LAUNCHES


def test_there_is_a_launch_to_speak_of():
    assert "launch" in warp_names(MODULES["device.launching"])


MOST_ARGUMENTS = 14
"""Of a kernel: more can hardly be read."""
LOOPS = {"device.pair_loops", "device.neighbours", "study.one_kernel_loops"}
"""Modules that may count neighbours: one writes loops, one lists neighbours, and one is wrong on purpose."""


@pytest.mark.parametrize("module", sorted(MODULES))
def test_kernels_can_be_read(module):
    text = MODULES[module].read_text()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef) and any("wp.kernel" in ast.unparse(one) for one in node.decorator_list):
            assert len(node.args.args) <= MOST_ARGUMENTS, f"{node.name} takes too many arguments: bundle some"
    assert module in LOOPS or "s.fluid_count[" not in text, "sums over neighbours are made: cortado.device.pair_sums"


def test_import_is_light():
    program = "import sys, cortado; print(*(n for n in ('warp', 'matplotlib', 'scipy') if n in sys.modules))"
    found = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout.split()
    assert not found, f"import cortado alone imports {', '.join(found)}"


WITHOUT_WARP = [
    "errors",
    "parameters.values",
    "lattice.calibration",
    "scene.scene",
    "discretise.discrete_scene",
    "reference",
]
"""What an engine without Warp stands on."""


@pytest.mark.parametrize("module", WITHOUT_WARP)
def test_the_discretisation_is_without_warp(module):
    program = f"import sys, cortado.{module}; print('warp' in sys.modules)"
    found = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout.split()
    assert found == ["False"], f"cortado.{module} imports Warp on the way"
