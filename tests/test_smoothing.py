"""Smoothing kernels against formulae derived here, finite differences, and the integral that they must have."""

import itertools
from functools import cache
from math import factorial, pi

import numpy as np
import pytest
import warp as wp

from cortado.device.precision import FLOAT32, FLOAT64
from cortado.discretise.smoothing import (
    KERNELS,
    RATE_LIMIT,
    SLACK,
    greatest_rate,
    pressure_stiffness,
    rest_volume,
    wall_response,
)
from cortado.discretise.smoothing_functions import smoothing_functions

SUPPORT = 0.13
SPACING = 0.05

# Pieces of W as coefficients in q = r / h, lowest power first: w(q) on [from, to], written out by hand.
PIECES = {
    "cubic_spline": [(0.0, 0.5, [1, 0, -6, 6]), (0.5, 1.0, [2, -6, 6, -2])],
    "wendland_c2": [(0.0, 1.0, [1, 0, -10, 20, -15, 4])],
    "wendland_c4": [(0.0, 1.0, [1, 0, -28 / 3, 0, 70, -448 / 3, 140, -64, 35 / 3])],
}
ACCURACY = {"float32": 2e-5, "float64": 1e-12}

names = pytest.mark.parametrize("name", KERNELS)
supports = pytest.mark.parametrize("support", [2.0, 2.5, 3.0])
precisions = pytest.mark.parametrize("precision", [FLOAT32, FLOAT64], ids=lambda precision: precision.name)


def kernels(test):
    """For each kernel in the plane and in space."""
    return names(pytest.mark.parametrize("dimension", [2, 3])(test))


def radial(name, r, derivative=0):
    """w(q) of a kernel at distances r [m], or a derivative with respect to q."""
    q = np.asarray(r, dtype=np.float64) / SUPPORT
    found = np.zeros_like(q)
    for lower, upper, coefficients in PIECES[name]:
        piece = np.polynomial.Polynomial(coefficients)
        for _ in range(derivative):
            piece = piece.deriv()
        found = np.where((q >= lower) & (q < upper), piece(q), found)
    return found


def sigma(name, dimension):
    """1 over the integral of w over the support, by exact integration of its polynomials."""
    sphere = 2 * pi if dimension == 2 else 4 * pi
    total = sum(
        coefficient * (upper**n - lower**n) / n
        for lower, upper, coefficients in PIECES[name]
        for n, coefficient in enumerate(coefficients, dimension)
    )
    return 1.0 / (sphere * total * SUPPORT**dimension)


def normals(x):
    r = np.linalg.norm(x, axis=-1)
    return r, x / np.where(r > 0, r, 1.0)[:, None]


def expected_gradient(name, dimension, x):
    r, n = normals(x)
    return (sigma(name, dimension) / SUPPORT * radial(name, r, 1))[:, None] * n


def expected_hessian(name, dimension, x):
    """W'' n n^T + (W' / r) (I - n n^T), and W''(0) I at r = 0."""
    r, n = normals(x)
    scale = sigma(name, dimension) / SUPPORT**2
    bend = scale * radial(name, r, 2)
    across = np.where(r > 0, scale * radial(name, r, 1) * SUPPORT / np.where(r > 0, r, 1.0), bend)
    along = n[:, :, None] * n[:, None, :]
    return bend[:, None, None] * along + across[:, None, None] * (np.eye(3) - along)


@cache
def evaluator(kernel, precision):
    functions = smoothing_functions(kernel, precision)
    weight, gradient = functions.weight, functions.gradient
    slope, slope_change = functions.slope, functions.slope_change
    real, numbers, vectors = precision.real, wp.array(dtype=precision.real), wp.array(dtype=precision.vector)
    module = wp.get_module(f"test_smoothing_{kernel.name}_{precision.name}")
    module.options.update({"enable_backward": False, "optimization_level": 1})

    @wp.kernel(module=module, enable_backward=False)
    def evaluate(x: vectors, u: vectors, per_h: real, sigma: real, w: numbers, g: vectors, hu: vectors):
        i = wp.tid()
        w[i] = weight(x[i], per_h, sigma)
        g[i] = gradient(x[i], per_h, sigma)
        hu[i] = slope(x[i], per_h, sigma) * u[i] + slope_change(x[i], u[i], per_h, sigma) * x[i]

    return evaluate


def evaluate(name, precision, dimension, x, u):
    """W, grad W and H u by the Warp functions, at separations (n, 3)."""
    n, kernel = len(x), KERNELS[name]
    inputs = [wp.array(values, dtype=precision.vector, device="cpu") for values in (x, u)]
    outputs = [wp.zeros(n, dtype=dtype, device="cpu") for dtype in (precision.real, precision.vector, precision.vector)]
    normalisation = kernel.normalisation(dimension, SUPPORT)
    wp.launch(evaluator(kernel, precision), n, inputs + [1.0 / SUPPORT, normalisation], outputs, device="cpu")
    return [out.numpy() for out in outputs]


def separations(dimension, n=400, furthest=1.4, seed=0):
    """(n, 3) separations up to beyond the support, and directions of size 1."""
    random = np.random.default_rng(seed)
    x, u = random.standard_normal((2, n, 3))
    x[:, dimension:], u[:, dimension:] = 0.0, 0.0
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return x * random.uniform(0.0, furthest * SUPPORT, (n, 1)), u / np.linalg.norm(u, axis=1, keepdims=True)


@kernels
def test_the_normalisation_is_exact_and_the_integral_one_on_a_lattice(name, dimension):
    assert KERNELS[name].normalisation(dimension, SUPPORT) == pytest.approx(sigma(name, dimension), rel=1e-12)
    cells = {2: 100, 3: 40}[dimension]
    axis = (np.arange(-cells, cells) + 0.5) / cells * SUPPORT
    r = np.sqrt(sum(a * a for a in np.meshgrid(*[axis] * dimension, sparse=True)))
    total = KERNELS[name].weight(r, dimension, SUPPORT).sum() * (SUPPORT / cells) ** dimension
    assert total == pytest.approx(1.0, abs=1e-8)


@kernels
def test_numpy_forms(name, dimension):
    x, _ = separations(dimension)
    r, x_d = np.linalg.norm(x, axis=1), x[:, :dimension]
    size = sigma(name, dimension)
    np.testing.assert_allclose(KERNELS[name].weight(r, dimension, SUPPORT), size * radial(name, r), atol=1e-12 * size)
    expected = expected_gradient(name, dimension, x)[:, :dimension]
    np.testing.assert_allclose(KERNELS[name].gradient(x_d, SUPPORT), expected, atol=1e-12 * size / SUPPORT)


@kernels
@precisions
def test_warp_forms_against_the_formulae(name, dimension, precision):
    x, u = separations(dimension)
    w, g, hu = evaluate(name, precision, dimension, x, u)
    size, accuracy = sigma(name, dimension), ACCURACY[precision.name]
    r = np.linalg.norm(x, axis=1)
    assert (r < SUPPORT).sum() > 200
    expected = np.einsum("nij,nj->ni", expected_hessian(name, dimension, x), u)
    np.testing.assert_allclose(w, size * radial(name, r), atol=accuracy * size)
    np.testing.assert_allclose(g, expected_gradient(name, dimension, x), atol=accuracy * size / SUPPORT)
    np.testing.assert_allclose(hu, expected, atol=20 * accuracy * size / SUPPORT**2)


@names
@precisions
@pytest.mark.parametrize("exponent", [-6, -20, -100, -400])
def test_nearly_coincident_particles(name, precision, exponent):
    """Down to numbers that underflow, and to 0: all is finite, and near the limit at r = 0."""
    x = np.array([[1.0, -2.0, 0.5]]) * 10.0**exponent
    u = np.array([[0.3, 0.4, -0.6]])
    w, g, hu = evaluate(name, precision, 3, x, u)
    size = sigma(name, 3)
    np.testing.assert_allclose(w, size, rtol=1e-4)
    np.testing.assert_allclose(g, 0.0, atol=2e-3 * size / SUPPORT)
    np.testing.assert_allclose(hu, size / SUPPORT**2 * radial(name, 0.0, 2) * u, rtol=2e-3)


@kernels
@precisions
def test_beyond_the_support_all_is_zero(name, dimension, precision):
    x, u = separations(dimension)
    directions = x / np.linalg.norm(x, axis=1, keepdims=True)
    for q in (1.00001, 1.03, 1.5, 10.0, 1e6):
        for found in evaluate(name, precision, dimension, q * SUPPORT * directions, u):
            np.testing.assert_array_equal(found, 0.0)


def block(dimension, n=9):
    """(n^d, d) a block of the lattice of the rest spacing, and the index of its middle."""
    points = SPACING * np.array(list(itertools.product(range(n), repeat=dimension)), dtype=np.float64)
    return points, len(points) // 2


def lowered(name, support, dimension):
    """What is left of the prototype's stiffness where the pressure iteration would diverge with it."""
    return min(1.0, RATE_LIMIT / greatest_rate(KERNELS[name], SPACING, support, dimension))


@kernels
@supports
def test_the_lattice_has_the_rest_density_less_the_slack(name, dimension, support):
    support *= SPACING
    points, middle = block(dimension)
    volume = rest_volume(KERNELS[name], SPACING, support, dimension)
    distances = np.linalg.norm(points - points[middle], axis=1)
    density = volume * KERNELS[name].weight(distances, dimension, support).sum()
    assert density == pytest.approx(1.0 - SLACK, rel=1e-12)
    assert volume == pytest.approx(SPACING**dimension, rel=0.2)
    assert 0.0 < SLACK <= 1e-3


@kernels
@supports
def test_pressure_stiffness_and_the_response_of_walls_are_what_the_sums_say(name, dimension, support):
    """delta = 1 / (beta (S . S + sum G . G)) with beta = 2 m^2 dt^2 / rho_0^2; the sum is the response of walls."""
    support *= SPACING
    rest_density, time_step = 870.0, 0.0021
    mass = rest_density * rest_volume(KERNELS[name], SPACING, support, dimension)
    points, middle = block(dimension)
    g = KERNELS[name].gradient(points[middle] - np.delete(points, middle, axis=0), support)
    total, squares = g.sum(axis=0), (g * g).sum()
    beta = 2 * mass**2 * time_step**2 / rest_density**2
    delta = 1.0 / (beta * (total @ total + squares))
    stiffness = pressure_stiffness(KERNELS[name], SPACING, support, dimension)
    assert stiffness == pytest.approx(delta * time_step**2 * lowered(name, support, dimension), rel=1e-12)
    assert stiffness > 0.0
    assert wall_response(KERNELS[name], SPACING, support, dimension) == pytest.approx(squares, rel=1e-12)


@kernels
@supports
def test_the_pressure_iteration_converges_on_the_lattice(name, dimension, support):
    """p <- p + delta (rho* - rho_0) linearised on a periodic lattice, as a matrix: its eigenvalues stay below 2."""
    support, n = support * SPACING, {2: 12, 3: 6}[dimension]
    points = np.array(list(itertools.product(range(n), repeat=dimension)))
    steps = points[:, None] - points[None, :]
    separation = SPACING * (steps - n * np.rint(steps / n))
    kernel, volume = KERNELS[name], rest_volume(KERNELS[name], SPACING, support, dimension)
    g = kernel.gradient(separation.reshape(-1, dimension), support).reshape(separation.shape)
    # x moves by -V sum_j (p_i + p_j) G_ij, the density by V sum_j G_ij . (x_i - x_j); the lattice has sum_j G_ij = 0.
    response = volume**2 * np.einsum("ija,jka->ik", g, g)
    rates = -pressure_stiffness(kernel, SPACING, support, dimension) * np.linalg.eigvalsh(response)
    assert rates.min() > -1e-9
    assert 0.5 < rates.max() < 1.01 * RATE_LIMIT < 2.0
    rate = greatest_rate(kernel, SPACING, support, dimension) * lowered(name, support, dimension)
    assert 0.8 * rate < rates.max() < 1.01 * rate


def test_the_polynomials_of_this_file_have_their_textbook_normalisations():
    """They were expanded by hand; Beta integrals of (1 - q)^4 (1 + 4 q) know nothing of that."""
    beta = factorial(4) * factorial(1) / factorial(6) + 4 * factorial(4) * factorial(2) / factorial(7)
    assert sigma("wendland_c2", 2) * SUPPORT**2 == pytest.approx(1 / (2 * pi * beta), rel=1e-14)
    assert sigma("cubic_spline", 3) * SUPPORT**3 == pytest.approx(8 / pi, rel=1e-14)
