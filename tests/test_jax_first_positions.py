"""The two inverse problems of JAX-SPH: the first positions of a cube of fluid from its last ones, in JAX."""

import numpy as np
import pytest

jax = pytest.importorskip("jax", reason="JAX is not installed", exc_type=ImportError)


@pytest.mark.parametrize(
    ("lower", "upper", "theirs"), [([0.5, 0.5], [0.8, 0.8], 0.008), ([0.5, 0.3], [0.8, 0.6], 0.023)]
)
def test_first_positions_are_found_from_last_ones(lower, upper, theirs):
    """After 7 iterations nearer than JAX-SPH's notebook after 15; the second cube hits the floor on the way. Steps are
    four times as long as in docs/layers.md, to be quick."""
    import cortado.jax

    box = cortado.load_scene("docs/figures/falling_cube.toml")
    box = box.replaced(f"fluid.0.lower={lower}", f"fluid.0.upper={upper}", "solver.time_step=0.02")
    guess = cortado.Simulation(box.replaced("fluid.0.lower=[0.075, 0.475]", "fluid.0.upper=[0.375, 0.775]"))
    true = cortado.Simulation(box)
    last = true.run(25).positions[-1]
    assert (last[:, 1].min() < 0.05) == (lower[1] < 0.5)
    distance = cortado.jax.value(cortado.Problem(guess, 25, cortado.losses.FinalPositions(last)))
    slope = jax.jit(jax.value_and_grad(lambda x: distance({"initial_positions": x})))
    positions = jax.numpy.asarray(guess.positions, dtype="float32")
    begun = np.sqrt(np.mean((positions - true.positions) ** 2))
    for _ in range(7):
        value, gradient = slope(positions)
        positions -= 0.25 * len(positions) * gradient
    assert np.sqrt(value / 2.0) < theirs
    assert np.sqrt(np.mean((positions - true.positions) ** 2)) < 0.2 * begun
