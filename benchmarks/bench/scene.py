"""The scene of benchmarks, of any size; the programs in ``benchmarks/peers`` simulate the same block."""

from typing import Any

from cortado.particles.neighbours import NeighbourSearch
from cortado.scene.fluids import BoxFluid
from cortado.scene.model import DiscretisationTable, Forces, Phase
from cortado.scene.scene import Scene
from cortado.scene.shape_tables import BoxContainer
from cortado.scene.solvers import PcisphSolver, ProjectionSolver
from cortado.simulation import Simulation
from cortado.solvers.particles import ParticleSolver

ITERATIONS = 5
"""Pressure iterations of every step of PCISPH, whatever the density error."""


def dam_break(particles: int, solver: str = "pcisph") -> Scene:
    """A cube of about that many particles beside an empty half of a box; PCISPH does `ITERATIONS` in each step, and the
    projection has what a scene has that says nothing of it, but for the time step."""
    edge = max(round(particles ** (1 / 3)), 2)
    spacing = 1.0 / edge
    gravity, time_step = (0.0, -9.81, 0.0), 0.02 * spacing
    counts = {"minimum_iterations": ITERATIONS, "maximum_iterations": ITERATIONS}
    kinds: dict[str, tuple[Forces, Any]] = {
        "projection": (Forces(gravity=gravity), ProjectionSolver(time_step=time_step)),
        "pcisph": (
            Forces(gravity=gravity, viscosity="pairwise"),
            PcisphSolver(kind="pcisph", time_step=time_step, **counts),
        ),
    }
    forces, kind = kinds[solver]
    return Scene(
        name="dam break",
        dimension=3,
        discretisation=DiscretisationTable(spacing=spacing),
        phase=(Phase(name="water", rest_density=1000.0, viscosity=0.05),),
        fluid=(BoxFluid(lower=(0.0, 0.0, 0.0), upper=(1.0, 1.0, 1.0), phase="water"),),
        container=BoxContainer(lower=(0.0, 0.0, 0.0), upper=(2.0, 1.5, 1.0)),
        forces=forces,
        solver=kind,
    )


def search_of(simulation: Simulation) -> NeighbourSearch:
    """The search for neighbours of a simulation of this scene."""
    solver = simulation.solver
    assert isinstance(solver, ParticleSolver)
    return solver.search
