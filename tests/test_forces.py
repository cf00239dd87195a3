"""What forces promise: they add to adjoints, whatever others have added before."""

import numpy as np
import pytest
import warp as wp

from cortado import Simulation
from cortado.device.precision import FLOAT64
from cortado.particles.solid_shares import SolidShares
from cortado.particles.state import Fields, Layout
from cortado.solvers.pcisph.derivatives import PcisphAdjoint
from cortado.sph.gravity import Gravity
from cortado.sph.parts import Adjoints, Shares
from scenes import plane_of_three, splash


def test_gravity_adds_to_its_adjoint():
    simulation = Simulation(splash(), precision="float64")
    solver, n = simulation.solver, simulation.particles
    bar = solver.new_parameters(2)
    bar["gravity"].assign(np.full((1, 2, 3), 0.5))
    fields = Fields.zeros(n, simulation.precision, simulation.device)
    shares = Shares(["time_step"], solver.layout)
    ones = wp.array(np.ones((n, 3)), dtype=wp.vec3d, device=simulation.device)
    solver.step_number.fill_(1)
    gravity, solids = Gravity(solver.layout, taped=False), SolidShares(None, solver.layout)
    for _ in range(2):
        gravity.adjoint(solver.context(solver.new_parameters(2)), ones, Adjoints(fields, bar, shares, solids))
    np.testing.assert_array_equal(bar["gravity"].numpy(), [[[0.5] * 3, [0.5 + 2 * n] * 3]])


@pytest.mark.parametrize("shares", ["drag", "gravity", "mass_fractions"])
def test_what_cannot_be_shared_is_said(shares):
    with pytest.raises(TypeError, match=f"shares has '{shares}', but must be a tuple of some of rest_density, "):
        Shares([shares], Layout(3, 1, FLOAT64, "cpu"))


def test_what_parts_added_to_parameters_is_kept_to_the_end():
    solver = Simulation(plane_of_three(), precision="float64").solver
    adjoint = PcisphAdjoint(solver, steps=2)
    for array in adjoint.bar.parameters.arrays():
        array.fill_(0.5)
    for array in adjoint.collect().arrays():
        np.testing.assert_array_equal(array.numpy(), 0.5)
