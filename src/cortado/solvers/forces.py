"""Force terms: objects that a scene lists, each with its acceleration, its tangent and its adjoint.

A term adds its acceleration [m / s2] to that of the terms before it. ``Pressure`` is not among them: it is solved
for, by the solver.
"""

from dataclasses import dataclass
from typing import Any, Protocol

import warp as wp

from cortado.launching import Launcher, TreeSum, sum_of
from cortado.particles import Fields, Parameters
from cortado.physics.gravity import gravity_kernels
from cortado.physics.surroundings import Discretisation
from cortado.physics.viscosity import (
    PairFunctions,
    laminar_functions,
    pairwise_functions,
    viscosity_kernels,
)
from cortado.walls.layers import WallLayers


@dataclass(frozen=True)
class Moment:
    """A step as a force term sees it: sorted particles with their surroundings, and the parameters."""

    launch: Launcher
    surroundings: Any
    fields: Fields
    parameters: Parameters
    step: wp.array
    """(1,) number of the step, on the device."""


@dataclass(frozen=True)
class Adjoints:
    """Where a term adds its share of the adjoints."""

    fields: Fields
    parameters: Parameters


class ForceTerm(Protocol):
    """An explicit force."""

    def accelerate(self, moment: Moment, before: wp.array, after: wp.array) -> None:
        """``after`` = ``before`` + this term's acceleration, both (n,) vectors."""

    def tangent(
        self, moment: Moment, fields: Fields, parameters: Parameters, before: wp.array, after: wp.array
    ) -> None:
        """The same for tangents, along the tangents ``fields`` and ``parameters``."""

    def adjoint(self, moment: Moment, acceleration: wp.array, adjoints: Adjoints) -> None:
        """Add to ``adjoints`` what the adjoint of the acceleration, (n,) vectors, asks for."""


class Gravity:
    """The same acceleration everywhere, one for each step (report eq. 8)."""

    def __init__(self, discretisation: Discretisation, particles: int, device: Any):
        self._kernels = gravity_kernels(discretisation.precision)
        self._sum: TreeSum = sum_of(discretisation.precision.vector, particles, device)

    def accelerate(self, moment: Moment, before: wp.array, after: wp.array) -> None:
        moment.launch(self._kernels.forward, [moment.parameters.gravity, moment.step, before], [after])

    def tangent(
        self, moment: Moment, fields: Fields, parameters: Parameters, before: wp.array, after: wp.array
    ) -> None:
        moment.launch(self._kernels.tangent, [parameters.gravity, moment.step, before], [after])

    def adjoint(self, moment: Moment, acceleration: wp.array, adjoints: Adjoints) -> None:
        total = self._sum(acceleration)
        moment.launch(self._kernels.adjoint, [total, moment.step], [adjoints.parameters.gravity], threads=1)


class Viscosity:
    """A viscous force between neighbours, and with walls (``friction`` 0 where these slip freely)."""

    def __init__(self, discretisation: Discretisation, form: PairFunctions, kappa: float, friction: float):
        self._kernels = viscosity_kernels(discretisation, form)
        self._kappa, self._friction = kappa, friction

    def accelerate(self, moment: Moment, before: wp.array, after: wp.array) -> None:
        f = moment.fields
        moment.launch(
            self._kernels.forward,
            [moment.surroundings, self._kappa, self._friction, f.x, f.v, f.n, f.m, f.mu, before],
            [after],
        )

    def tangent(
        self, moment: Moment, fields: Fields, parameters: Parameters, before: wp.array, after: wp.array
    ) -> None:
        f, d = moment.fields, fields
        moment.launch(
            self._kernels.tangent,
            [moment.surroundings, self._kappa, self._friction]
            + [f.x, d.x, f.v, d.v, f.n, d.n, f.m, d.m, f.mu, d.mu, before],
            [after],
        )

    def adjoint(self, moment: Moment, acceleration: wp.array, adjoints: Adjoints) -> None:
        f, bar = moment.fields, adjoints.fields
        moment.launch(
            self._kernels.adjoint,
            [moment.surroundings, self._kappa, self._friction, f.x, f.v, f.n, f.m, f.mu, acceleration],
            [bar.x, bar.v, bar.n, bar.m, bar.mu],
        )


def pairwise_viscosity(discretisation: Discretisation, dimension: int, wall: WallLayers | None) -> Viscosity:
    """The report's eq. 10 (Monaghan 2005): keeps linear and angular momentum. ``wall`` None: free slip."""
    return Viscosity(discretisation, pairwise_functions, 2.0 * (dimension + 2), friction=1.0 if wall else 0.0)


def laminar_viscosity(discretisation: Discretisation, dimension: int, wall: WallLayers | None) -> Viscosity:
    """Morris, Fox and Zhu (1997): carries shear to a wall. ``wall`` None: free slip."""
    return Viscosity(discretisation, laminar_functions, 2.0, friction=wall.friction if wall else 0.0)
