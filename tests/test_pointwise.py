"""Kernels that are made from a function of one particle: values by NumPy, derivatives by differences."""

import numpy as np
import pytest
import warp as wp

from cortado.device.modules import kernel_module
from cortado.device.precision import FLOAT32, FLOAT64
from cortado.particles.made_derivatives import pointwise_kernels

MEMBERS, PARTICLES = 2, 5


def made(precision, replaced=None):
    real, vector, matrix = precision.real, precision.vector, wp.types.matrix((3, 3), precision.real)

    def make(module):
        def turn(spacing: real, time_step: real, x_i: vector, A_i: matrix, m_i: real) -> tuple[vector, real]:
            moved = A_i * (time_step * x_i) / m_i
            return moved / spacing, wp.dot(moved, x_i) * spacing

        return turn

    modules = [kernel_module(f"pointwise_{kind}_{precision.name}") for kind in "abc"]
    return pointwise_kernels(precision, modules, make, ["moved", "work"], replaced, numbers=["spacing"])


def wanted(spacing, time_step, x, A, m):
    moved = np.einsum("nij,nj->ni", A, np.repeat(time_step, PARTICLES)[:, None] * x) / m[:, None]
    return moved / spacing, (moved * x).sum(1) * spacing


@pytest.mark.parametrize("precision", [FLOAT32, FLOAT64])
def test_values_and_derivatives(precision):
    rng, n = np.random.default_rng(7), MEMBERS * PARTICLES
    given = [rng.uniform(0.5, 1.5, size) for size in (MEMBERS, (n, 3), (n, 3, 3), n)]
    ways = [rng.normal(size=value.shape) for value in given]
    bars = [rng.normal(size=(n, 3)), rng.normal(size=n)]
    kinds = [precision.real, precision.vector, wp.types.matrix((3, 3), precision.real), precision.real]
    names, kernels = ["time_step", "x", "A", "m"], made(precision)

    def on_device(values, kinds, suffix=""):
        arrays = (wp.array(value, dtype=kind) for value, kind in zip(values, kinds, strict=True))
        return {f"{name}{suffix}": array for name, array in zip(names, arrays, strict=False)}

    def launched(kernel, **arrays):
        values = {"particles": PARTICLES, "spacing": 0.3, **on_device(given, kinds), **arrays}
        inputs = []
        for argument in kernel.adj.args:
            if argument.label in ("dot", "bar"):
                struct = argument.type()
                for name in names:
                    setattr(struct, name, arrays[f"{name}_{argument.label}"])
                inputs.append(struct)
            else:
                inputs.append(values[argument.label])
        wp.launch(kernel, dim=n, inputs=inputs)

    def results():
        return wp.zeros(n, dtype=precision.vector), wp.zeros(n, dtype=precision.real)

    tolerance, found, change = (1e-5 if precision is FLOAT32 else 1e-8), results(), results()
    launched(kernels.forward, moved=found[0], work=found[1])
    launched(kernels.tangent, **on_device(ways, kinds, "_dot"), moved_dot=change[0], work_dot=change[1])
    back = on_device([np.zeros((n, *value.shape[1:])) for value in given], kinds, "_bar")
    launched(
        kernels.adjoint,
        **back,
        moved_bar=wp.array(bars[0], dtype=precision.vector),
        work_bar=wp.array(bars[1], dtype=precision.real),
    )
    step = 1e-6
    ahead, behind = (wanted(0.3, *(v + sign * step * w for v, w in zip(given, ways, strict=True))) for sign in (1, -1))
    for value, by_tangent, right, a, b in zip(found, change, wanted(0.3, *given), ahead, behind, strict=True):
        np.testing.assert_allclose(value.numpy(), right, rtol=tolerance)
        np.testing.assert_allclose(by_tangent.numpy(), (a - b) / (2 * step), rtol=100 * tolerance, atol=tolerance)
    forward = sum((bar * tangent.numpy()).sum() for bar, tangent in zip(bars, change, strict=True))
    ways[0] = np.repeat(ways[0], PARTICLES)  # shares of a scene's parameter stand at its particles
    backward = sum((back[f"{name}_bar"].numpy() * way).sum() for name, way in zip(names, ways, strict=True))
    assert backward == pytest.approx(forward, rel=tolerance)


def test_an_adjoint_may_stand_where_that_of_a_result_stood():
    kernel = made(FLOAT64, {"moved": "x"}).adjoint
    assert "moved_bar" not in {argument.label for argument in kernel.adj.args}
    assert "bar.x[i] = _by_x" in kernel.adj.source and "bar.m[i] = bar.m[i] + _by_m" in kernel.adj.source
