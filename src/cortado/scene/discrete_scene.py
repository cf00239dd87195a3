"""A scene cut into particles: first particles, walls, and the constants of the lattice. NumPy in float64 throughout.

It is the same for every device, every precision and every engine.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from cortado.discretise.calibration import (
    lattice_laplacian_correction,
    pressure_stiffness,
    rest_volume,
    wall_response,
)
from cortado.discretise.packing import Packing
from cortado.discretise.pairs import check_crowding
from cortado.discretise.room import Domain, Region
from cortado.discretise.shapes import Points
from cortado.discretise.smoothing import SmoothingKernel, smoothing_kernel
from cortado.discretise.walls import RestLattice, WallLayers, wall_layers
from cortado.errors import MassWarning, warn
from cortado.scene.bodies import Surroundings
from cortado.scene.fluid_masses import FluidMasses
from cortado.scene.fluids import PointsFluid
from cortado.scene.sampling import FluidSample, fluid_particles, period
from cortado.scene.scene import Scene
from cortado.scene.standing_solids import standing_sentences
from cortado.scene.thin_walls import thin_sentences
from cortado.scene.walls import Walls, walls_of


@dataclass(frozen=True)
class Lattice:
    """Constants of the rest lattice and of the kernel on it."""

    support: float
    """Support radius h [m]."""
    normalisation: float
    """sigma [1 / m^d]."""
    self_weight: float
    """W(0) [1 / m^d]."""
    volume: float
    """V_0 [m^d], with which the sums of the kernel over the lattice give the rest density; of sums of kernels alone."""
    cell: float
    """Volume of a particle [m^d], a cell of the lattice: its mass is the rest density times it."""
    stiffness: float
    """k [m2]: delta = k / dt^2 [Pa m3 / kg] (Solenthaler and Pajarola 2009) for a filled neighbourhood."""
    response: float
    """sum_j G_j . G_j [1 / m^(2 d + 2)]: the scale of `cortado.solvers.pcisph.relaxation`."""
    laplacian_correction: float
    """[-], see `cortado.discretise.calibration.lattice_laplacian_correction`."""
    domain: Domain
    """Along which axes it repeats."""

    @classmethod
    def of(cls, kernel: SmoothingKernel, spacing: float, support: float, dimension: int, domain: Domain) -> "Lattice":
        """Those of a kernel with a support radius [m] on a lattice with a spacing [m]."""
        return cls(
            support=support,
            normalisation=kernel.normalisation(dimension, support),
            self_weight=float(kernel.weight(np.zeros(1), dimension, support)[0]),
            volume=rest_volume(kernel, spacing, support, dimension),
            cell=spacing**dimension,
            stiffness=pressure_stiffness(kernel, spacing, support, dimension),
            response=wall_response(kernel, spacing, support, dimension),
            laplacian_correction=lattice_laplacian_correction(kernel, spacing, support, dimension),
            domain=domain,
        )


@dataclass(frozen=True)
class DiscreteScene:
    """What a solver starts from, besides what the scene says itself."""

    kernel: SmoothingKernel
    """The smoothing kernel W."""
    lattice: Lattice
    """Constants."""
    fluid: FluidSample
    """The first fluid particles."""
    masses: FluidMasses
    """Theirs, and those that were asked for."""
    wall_layers: WallLayers
    """How the walls lie and how they drag; also for a scene without walls."""
    walls: Walls
    """The wall particles; none without a container and solids."""
    periods: Points
    """(d,) lengths of the period [m], 0 along an axis that is not periodic."""

    @cached_property
    def near(self) -> Region:
        """A box around all first particles and walls."""
        everything = np.concatenate([self.fluid.positions, self.walls.positions])
        return Region.between(everything.min(axis=0), everything.max(axis=0))


def discretise(scene: Scene) -> DiscreteScene:
    """Cut a scene into particles. Raises `InputError` if a file with points is gone since the scene was read, or if
    points are packed too densely; warns where the fluid has another mass than was asked for."""
    kernel, dimension = smoothing_kernel(scene.discretisation.kernel), scene.dimension
    spacing, support = scene.discretisation.spacing, scene.discretisation.support_radius
    at_rest = RestLattice(kernel, spacing, support, dimension)
    layers = wall_layers(at_rest)
    lattice = Lattice.of(kernel, spacing, support, dimension, scene.container.domain(dimension))
    fluid = fluid_particles(scene)
    walls = walls_of(scene, layers, at_rest)
    fluid = _packed(fluid, walls, at_rest, *period(scene))
    masses = FluidMasses.of(scene, fluid)
    for sentence in (*thin_sentences(scene), *standing_sentences(scene)):
        warn(sentence)
    if masses.warning:
        warn(masses.warning, MassWarning)
    if scene.discretisation.jitter:
        fluid = replace(fluid, positions=fluid.jittered(scene.discretisation.jitter * spacing))
    fluid = replace(fluid, velocities=_velocities(scene, fluid))
    if any(isinstance(body, PointsFluid) for body in scene.fluid):
        of_lattice = kernel, support, lattice.volume, spacing
        told = check_crowding("the points of the fluid", fluid.positions, *of_lattice, period(scene))
        if told is not None:
            warn(told)
    return DiscreteScene(kernel, lattice, fluid, masses, layers, walls, period(scene)[1])


def _velocities(scene: Scene, fluid: FluidSample) -> Points:
    """(n, d) first velocities [m/s], where those of a body that spins follow from the places of its particles."""
    found, ends = fluid.velocities.copy(), np.cumsum(fluid.sizes)
    for body, end, size in zip(scene.fluid, ends, fluid.sizes, strict=True):
        found[end - size : end] = body.velocities(fluid.positions[end - size : end])
    return found


def _packed(fluid: FluidSample, walls: Walls, lattice: RestLattice, lower: Points, lengths: Points) -> FluidSample:
    """The fluid with the particles of round bodies where they fill these at the rest density."""
    if not fluid.bodies:
        return fluid
    stays = ~fluid.is_packed
    air, shares = Surroundings(fluid.bodies, fluid.positions[stays], lower, lengths).air(lattice.support)
    fixed, weights = np.concatenate([air, walls.positions]), np.append(shares, walls.weights)
    found, kept = Packing(lattice, fixed, weights, len(air), lengths).packed(fluid.positions, stays)
    return replace(fluid.some(kept), positions=found)
