"""A force on each particle that is one function of a user's: a_i = f(x_i, v_i, t, theta) [m/s2].

Its adjoint is Warp's own of the product f . a_bar; its tangent is put together of the gradients of its components, so
that both are exact.
"""

from functools import cache

import warp as wp

from cortado.device.modules import Kernels
from cortado.particles.neighbourhood import Discretisation, neighbourhood_type
from cortado.sph.formula import Formula
from cortado.sph.formula_kernels import applied, change_along, work_of
from cortado.sph.own_force import OwnForce, topic
from cortado.sph.packed import theta_of


@cache
def body_kernels(discretisation: Discretisation, text: Formula, ranks: tuple[int, ...], dimension: int) -> Kernels:
    """Of a function whose parameters are numbers (rank 0) and vectors (rank 1), in a scene of 2 or 3 dimensions."""
    vector = discretisation.precision.vector
    theta_type = theta_of(discretisation.precision, ranks)
    neighbourhood = neighbourhood_type(discretisation.precision)
    name = topic("body", text, ranks, dimension)
    module = discretisation.module(True, name)
    tangent_module, adjoint_module = discretisation.tangent_module(name), discretisation.module(False, name)
    force = applied(text, discretisation.precision, ranks, dimension, module)
    change_of = change_along(text, discretisation.precision, ranks, dimension, tangent_module)
    work = work_of(text, discretisation.precision, ranks, dimension, adjoint_module)

    @wp.kernel(module=module)
    def body(
        s: neighbourhood,
        theta: wp.array(dtype=theta_type),
        x: wp.array(dtype=vector),
        v: wp.array(dtype=vector),
        acceleration_in: wp.array(dtype=vector),
        # out
        acceleration: wp.array(dtype=vector),
    ):
        i = s.first + wp.tid()
        acceleration[i] = acceleration_in[i] + force(x[i], v[i], theta[i // s.particles])

    @wp.kernel(module=tangent_module, enable_backward=False)
    def body_tangent(
        s: neighbourhood,
        theta: wp.array(dtype=theta_type),
        theta_dot: wp.array(dtype=theta_type),
        x: wp.array(dtype=vector),
        x_dot: wp.array(dtype=vector),
        v: wp.array(dtype=vector),
        v_dot: wp.array(dtype=vector),
        acceleration_in_dot: wp.array(dtype=vector),
        # out
        acceleration_dot: wp.array(dtype=vector),
    ):
        i = s.first + wp.tid()
        member = i // s.particles
        change = change_of(x[i], v[i], theta[member], x_dot[i], v_dot[i], theta_dot[member])
        acceleration_dot[i] = acceleration_in_dot[i] + change

    @wp.kernel(module=adjoint_module, enable_backward=False)
    def body_adjoint(
        s: neighbourhood,
        theta: wp.array(dtype=theta_type),
        x: wp.array(dtype=vector),
        v: wp.array(dtype=vector),
        acceleration_bar: wp.array(dtype=vector),
        # in and out
        x_bar: wp.array(dtype=vector),
        v_bar: wp.array(dtype=vector),
        # out
        theta_bar: wp.array(dtype=theta_type),
    ):
        i = s.first + wp.tid()
        own_x_bar, own_v_bar, own_theta_bar, _bar_bar = wp.grad(work)(
            x[i], v[i], theta[i // s.particles], acceleration_bar[i]
        )
        x_bar[i] = x_bar[i] + own_x_bar
        v_bar[i] = v_bar[i] + own_v_bar
        theta_bar[i] = own_theta_bar

    return Kernels(body, body_tangent, body_adjoint)


class Body(OwnForce):
    """A force on each particle: ``function(x, v, t, ...)`` returns its acceleration [m/s2], as gravity is one, from the
    position [m], the velocity [m/s] and the time [s] of the particle; time may be left out."""

    kind = "Body"

    def kernels(self, discretisation: Discretisation, dimension: int) -> Kernels:
        return body_kernels(discretisation, self._formula, tuple(p.rank for p in self.parameters), dimension)
