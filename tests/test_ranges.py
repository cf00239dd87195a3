"""Every kernel that sums over neighbours gives the same bits in several ranges of particles as in one."""

import ast
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import warp as wp

import cortado
from cortado import Problem, Simulation, forces, gradients
from cortado.device import launching
from cortado.device.launching import KernelLauncher
from scenes import MIXING, Weighed, box, jet, plane, plane_of_three, scene, splash, two_layers
from test_faces import FLAP, flume
from test_sheets import SCENES as SHEETS

ROOT = Path(cortado.__file__).parent
BINGHAM = {"kind": "bingham", "yield_stress": 10.0, "regularisation": 0.5}
FALL = {"gravity": [0.0, -9.81, 0.0]}
STRESS = {"gravity": [1.0, -9.81, 0.0], "viscosity": "stress"}
TENSE = {
    "forces": FALL | {"surface_tension": 0.5},
    "phase": [{"name": "water", "rest_density": 1000.0, "viscosity": 2.0}],
}
NO_SLIP = box([0.0] * 3, [0.4, 0.6, 0.25], slip="no")
PROJECTION = {"kind": "projection", "time_step": 0.0021}
BALL = {"name": "ball", "shape": "sphere", "centre": [0.1] * 3, "radius": 0.06, "velocity": [0.5, 0.0, 0.0]}
ALONG = {"motion": "path", "slip": "no"}
CASES = {
    "one phase, iterations by tolerance": lambda: splash(minimum_iterations=2, maximum_iterations=20),
    "no viscosity, free space": lambda: scene(forces=FALL | {"viscosity": "none"}, container={"shape": "none"}),
    "pairwise, no slip, diffusion of two phases": lambda: two_layers(container=NO_SLIP),
    "diffusion of three phases, a constant mobility": plane_of_three,
    "diffusion of three phases, miscible": lambda: plane_of_three(mixture={**MIXING, "free_energy": "miscible"}),
    "a nozzle": jet,
    "surface tension": lambda: scene(**TENSE),
    "surface tension by curvature": lambda: scene(solver=PROJECTION, **TENSE),
    "implicit viscosity with a law, no slip": lambda: scene(
        forces=STRESS | {"viscous_solve": "implicit"},
        phase=[{"name": "water", "rest_density": 1000.0, "viscosity": 20.0, "rheology": BINGHAM}],
        container=NO_SLIP,
    ),
    "forces of one's own": splash,
    "the projection": lambda: plane(solver=PROJECTION),
    "the projection of two layers": lambda: two_layers(solver=PROJECTION),
    "velocities that follow": lambda: two_layers(solver=PROJECTION | {"velocities_follow": True}),
    "a solid that moves": lambda: scene(solid=[BALL | ALONG], solver=PROJECTION),
    "a solid that moves, PCISPH, stress": lambda: scene(forces=STRESS, solid=[BALL | ALONG]),
    "a solid that moves, PCISPH, pairwise": lambda: scene(solid=[BALL | ALONG]),
    "a face that mirrors": flume,
    "a face that mirrors, with the mean stress": lambda: flume(
        {**FLAP, "slip": "no"}, forces={"gravity": [1.0, -9.81], "viscosity": "stress"}
    ),
    "sheets": SHEETS["plane"],
    "a solid that is free": lambda: scene(solid=[BALL | {"motion": "free", "density": 500.0}], solver=PROJECTION),
}


def swirl(x, v, t, rate):
    return rate * wp.vec3(-x[1], x[0], wp.sin(t)) - v


def spring(x_ij, v_ij, k):
    return -k * x_ij - 0.1 * k * v_ij


FORCES = {"forces of one's own": [forces.Body(swirl, rate=2.0), forces.Pair(spring, k=3.0)]}
ESTIMATORS = {"exact": gradients.Exact(), "adjoint viscosity": gradients.AdjointViscosity(5.0)}
CORES_AND_PARTS = ((2, 2), (2, 8), (5, 5))
"""All of them in the first case, and one of them in each of the others, in turn: how launches are cut does not depend
on the kernel."""
STEPS = 4


class Seen(Weighed):
    """A linear loss of quantities that are sums over neighbours too."""

    def __init__(self, simulation):
        names = ["pressure", "vorticity", "wall_force", *(f"{solid.name}.load" for solid in simulation.scene.solid)]
        random, first = np.random.default_rng(9), {name: simulation.quantity(name) for name in names}
        self.weights = {name: random.standard_normal(array.shape) for name, array in first.items()}


def results(name) -> dict[str, bytes]:
    simulation = Simulation(CASES[name](), precision="float64", forces=FORCES.get(name, []))
    problem, random = Problem(simulation, STEPS, Weighed(simulation)), np.random.default_rng(2)
    point = simulation.parameters()
    for name, size in (("initial_positions", 0.002), ("initial_velocities", 0.3)):
        point[name] = point[name] + size * random.standard_normal(point[name].shape)
    if "mass_fractions" in point:
        c = point["mass_fractions"]
        point["mass_fractions"] = 0.8 * c + 0.2 * random.dirichlet(np.ones(c.shape[1]), len(c))
    directions = {name: random.standard_normal(np.shape(value)) for name, value in point.items()}
    found = {"value": problem.value(point), "tangent": problem.tangent(point, directions)}
    found["iterations"] = problem.iterations()
    for label, estimator in ESTIMATORS.items():
        _, gradient = problem.value_and_gradient(point, estimator)
        found |= {f"{label}, {name}": array for name, array in gradient.items()}
    seen = Problem(simulation, STEPS, Seen(simulation))
    for _ in range(2):  # a kernel is compiled whole
        found |= {"seen": seen.value(point), "seen, tangent": seen.tangent(point, directions)}
        found |= {f"seen, {name}": array for name, array in seen.value_and_gradient(point)[1].items()}
    return {name: np.asarray(array).tobytes() for name, array in found.items()}


def set_parts(monkeypatch, cores, parts, particles):
    monkeypatch.setattr(launching, "LEAST_PART", particles // parts)
    monkeypatch.setattr(launching, "LEAST_SHARED_PART", particles // parts if parts > cores else particles)
    monkeypatch.setattr(launching, "usable_cores", lambda: cores)
    launcher = KernelLauncher(particles, launching.wp.get_device("cpu"), record_tape=False)
    assert launcher.parts == parts and launcher.capturable == (parts == 1)


@cache
def once_and_cut(name):
    """Results of a case in one range, those in several, and the names of kernels that were launched range by range."""
    particles, cut, launch_parts = Simulation(CASES[name]()).particles, set(), KernelLauncher._launch_parts

    def keep(self, kernel, inputs):
        cut.add(kernel.key.split("__locals__")[-1])
        launch_parts(self, kernel, inputs)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(KernelLauncher, "_launch_parts", keep)
        set_parts(patch, 1, 1, particles)
        once = results(name)
        assert not cut
        several = []
        k = list(CASES).index(name)
        for cores, parts in CORES_AND_PARTS if k == 0 else CORES_AND_PARTS[k % 3 :][:1]:
            set_parts(patch, cores, parts, particles)
            several.append(results(name))
    return once, several, cut


@pytest.mark.parametrize("name", CASES)
def test_any_number_of_ranges_gives_the_same_bits(name):
    once, several, _ = once_and_cut(name)
    estimates = [what for what in once if what.endswith(", initial_velocities")]
    assert len(estimates) >= 3 and all(any(once[what]) for what in ("value", "tangent", *estimates))
    for found in several:
        assert [what for what in once if found[what] != once[what]] == []


def sums_over_neighbours() -> set[str]:
    """Names of all kernels that a file writes and whose first argument is what lies around a particle, and of those
    that are made of what a sum gives to solids."""
    names = set()
    for path in ROOT.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef) and node.args.args:
                if node.name.endswith("_work") and node.args.args[-1].arg == "s":
                    names.add(f"{node.name}_share")
                if "kernel" in " ".join(map(ast.unparse, node.decorator_list)) and node.args.args[0].arg == "s":
                    names.add(node.name)
    return names


def test_every_sum_over_neighbours_is_cut_in_some_case():
    wanted, cut = sums_over_neighbours(), set().union(*(once_and_cut(name)[2] for name in CASES))
    assert len(wanted) >= 30 and wanted <= cut, wanted - cut
