"""PCISPH written in JAX, as somebody who uses JAX would: jitted, and differentiable with ``jax.grad``.

    python benchmarks/peers/jax_pcisph.py --particles 8000 --json

The dam break of `benchmarks.bench.scene` with the same particles, time step, smoothing kernel, viscosity and number of
pressure iterations (Solenthaler and Pajarola 2009), on whatever device JAX finds. Every step sorts the particles by
cell and lists their neighbours anew, in lists of a fixed length. A rollout is a scan whose steps are checkpointed, so
that the way back keeps the states and computes the rest again, as Cortado does.

What differs from Cortado: walls are planes at which positions are cut off, not particles, so that a particle has some
28 neighbours instead of 31, and fluid beside a wall has too low a density and comes closer together there.

`--check` instead holds the gradient against finite differences, in float64.
"""

import argparse
import itertools
import json
import time
from functools import partial
from statistics import median
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

REST_DENSITY, VISCOSITY, GRAVITY = 1000.0, 0.05, (0.0, -9.81, 0.0)
BOX = (2.0, 1.5, 1.0)
ITERATIONS = 5
SKIN = 1.03
"""How far lists reach, in support radii: density is also taken at predicted positions."""
CAPACITY, ROW = 56, 80
"""Neighbours in a list, and particles in three cells beside one another; `Checks` tells whether they suffice."""


class Block(NamedTuple):
    """The constants of a block of ``edge``^3 particles."""

    edge: int
    spacing: float
    support: float
    time_step: float
    mass: float
    stiffness: float
    """delta of the pressure iteration [m2 / s2]."""
    corner: float
    """Of the block, along every axis [m]."""
    box: tuple[float, float, float]
    """Its walls stand at 0 and here [m]."""


class State(NamedTuple):
    """The particles, sorted by cell."""

    x: jax.Array
    v: jax.Array
    number: jax.Array
    """(n,) of each particle, in the order in which they began."""


class Checks(NamedTuple):
    """What a user looks at after a run."""

    neighbours: jax.Array
    """The longest list."""
    row: jax.Array
    """The most particles in three cells."""
    density_error: jax.Array
    """Mean of (rho* - rho_0)+ / rho_0 in the last iteration."""


def weight(x: jax.Array, h: float) -> jax.Array:
    """The cubic spline of support h in 3-D."""
    q = jnp.sqrt((x * x).sum(-1) + 1e-12 * h * h) / h  # the root has no derivative at 0
    inner, outer = 6.0 * (q**3 - q**2) + 1.0, 2.0 * jnp.maximum(1.0 - q, 0.0) ** 3
    return 8.0 / (jnp.pi * h**3) * jnp.where(q < 0.5, inner, outer)


def gradient(x: jax.Array, h: float) -> jax.Array:
    """Its gradient."""
    q = jnp.sqrt((x * x).sum(-1) + 1e-12 * h * h) / h
    slope = jnp.where(q < 0.5, 18.0 * q - 12.0, -6.0 * jnp.maximum(1.0 - q, 0.0) ** 2 / q)  # w' / q
    return (8.0 / (jnp.pi * h**5) * slope)[..., None] * x


def block(particles: int, corner: float = 0.0, box: tuple[float, float, float] = BOX) -> Block:
    """A cube of about that many particles, 1 m long."""
    edge = max(round(particles ** (1 / 3)), 2)
    spacing = 1.0 / edge
    support, time_step = 2.0 * spacing, 0.02 * spacing
    lattice = spacing * jnp.array(list(itertools.product(range(-2, 3), repeat=3)), dtype=float)
    mass = REST_DENSITY * (1.0 - 1e-4) / weight(lattice, support).sum()
    squares = (gradient(lattice, support) ** 2).sum()
    stiffness = REST_DENSITY**2 / (2.0 * mass**2 * time_step**2 * squares)
    return Block(edge, spacing, support, time_step, float(mass), float(stiffness), corner, box)


def first_state(b: Block) -> State:
    axis = b.corner + (jnp.arange(b.edge) + 0.5) * b.spacing
    x = jnp.stack(jnp.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    return State(x, jnp.zeros_like(x), jnp.arange(len(x)))


def cells(x: jax.Array, b: Block) -> tuple[jax.Array, tuple[int, int, int]]:
    """The cell of each particle in a grid with a rim of empty cells, and the shape of the grid."""
    width = SKIN * b.support
    across, high, deep = (int(np.ceil(length / width)) + 2 for length in b.box)
    c = jnp.floor(x / width).astype(jnp.int32) + 1
    return (c[:, 2] * high + c[:, 1]) * across + c[:, 0], (across, high, deep)


def neighbour_lists(x: jax.Array, cell: jax.Array, shape: tuple[int, int, int], b: Block) -> tuple[Any, ...]:
    """(n, `CAPACITY`) neighbours of particles that are sorted by cell, filled up with the particle itself; their
    numbers (n,), and the most particles in a row of three cells."""
    n = len(x)
    own = jnp.arange(n)[:, None]
    starts = jnp.searchsorted(cell, jnp.arange(shape[0] * shape[1] * shape[2] + 1))
    rows = jnp.array([(z * shape[1] + y) * shape[0] for z in (-1, 0, 1) for y in (-1, 0, 1)])

    def look(found: tuple[Any, ...], row: jax.Array) -> tuple[tuple[Any, ...], None]:
        lists, count, most = found
        first, last = starts[cell + row - 1], starts[cell + row + 2]
        j = first[:, None] + jnp.arange(ROW)
        apart = x[:, None] - x[jnp.minimum(j, n - 1)]
        near = (j < last[:, None]) & (j != own) & ((apart * apart).sum(-1) < (SKIN * b.support) ** 2)
        slot = jnp.where(near, count[:, None] + jnp.cumsum(near, axis=1) - 1, CAPACITY)
        lists = lists.at[own, slot].set(j, mode="drop")
        return (lists, count + near.sum(axis=1), jnp.maximum(most, (last - first).max())), None

    start = jnp.broadcast_to(own, (n, CAPACITY)), jnp.zeros(n, dtype=int), jnp.zeros((), dtype=starts.dtype)
    return jax.lax.scan(look, start, rows)[0]


def step(state: State, gravity: jax.Array, b: Block) -> tuple[State, Checks]:
    """One step of PCISPH."""
    cell, shape = cells(jax.lax.stop_gradient(state.x), b)
    order = jnp.argsort(cell)
    x, v, number = state.x[order], state.v[order], state.number[order]
    lists, count, most = neighbour_lists(jax.lax.stop_gradient(x), cell[order], shape, b)
    surplus = 1 - CAPACITY + jnp.minimum(count, CAPACITY)  # the particle itself counts once

    def density(x: jax.Array) -> jax.Array:
        weights = weight(x[:, None] - x[lists], b.support).sum(axis=1)
        return b.mass * (weights + surplus * weight(jnp.zeros(3), b.support))

    apart, faster = x[:, None] - x[lists], v[:, None] - v[lists]
    g = gradient(apart, b.support)
    rho = density(x)
    closing = (faster * apart).sum(-1) / ((apart * apart).sum(-1) + 0.01 * b.support**2)
    friction = 10.0 * VISCOSITY * b.mass * (((closing / rho[lists])[..., None] * g).sum(axis=1)) / rho[:, None]
    a = gravity + friction

    def predict(a: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Positions and velocities, cut off where they would leave the box."""
        x_new = x + b.time_step * (v + b.time_step * a)
        x_new = jnp.clip(x_new, 0.5 * b.spacing, jnp.array(b.box) - 0.5 * b.spacing)
        return x_new, (x_new - x) / b.time_step

    def iterate(carry: tuple[Any, ...], _: None) -> tuple[tuple[Any, ...], jax.Array]:
        p, x_star, _ = carry
        excess = density(x_star) - REST_DENSITY
        p = jnp.maximum(p + b.stiffness * excess, 0.0)
        c = p / rho**2
        push = -b.mass * ((c[:, None] + c[lists])[..., None] * g).sum(axis=1)
        return (p, *predict(a + push)), jnp.maximum(excess / REST_DENSITY, 0.0).mean()

    (_, x_new, v_new), errors = jax.lax.scan(iterate, (jnp.zeros(len(x), x.dtype), *predict(a)), length=ITERATIONS)
    return State(x_new, v_new, number), Checks(count.max(), most, errors[-1])


@partial(jax.jit, static_argnames=("b", "steps"))
def rollout(gravity: jax.Array, b: Block, steps: int) -> tuple[jax.Array, tuple[State, Checks]]:
    """Mean squared distance from the first positions after some steps; the last state, and `Checks` of all steps."""
    one = jax.checkpoint(lambda state, _: step(state, gravity, b))
    start = first_state(b)
    end, checks = jax.lax.scan(one, start, length=steps)
    return ((end.x - start.x[end.number]) ** 2).sum(axis=1).mean(), (end, checks)


with_gradient = jax.jit(jax.value_and_grad(rollout, has_aux=True), static_argnames=("b", "steps"))


def median_seconds(work: Any, repeats: int) -> float:
    """Seconds of the median of some repeats, after one that compiles."""
    jax.block_until_ready(work())
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(work())
        times.append(time.perf_counter() - start)
    return median(times)


def measure(particles: int, steps: int, repeats: int) -> dict[str, Any]:
    """Times [ms a step], memory, and what tells whether the run was right."""
    b, gravity = block(particles), jnp.array(GRAVITY)
    forward = median_seconds(lambda: rollout(gravity, b, steps), repeats)
    backward = median_seconds(lambda: with_gradient(gravity, b, steps), repeats)
    loss, (end, checks) = rollout(gravity, b, steps)
    if int(checks.neighbours.max()) > CAPACITY or int(checks.row.max()) > ROW:
        raise SystemExit(f"lists are too short: {checks.neighbours.max()} neighbours, {checks.row.max()} in a row")
    device = jax.devices()[0]
    row = {
        "peer": "PCISPH in JAX",
        "version": f"jax {jax.__version__}",
        "device": device.device_kind,
        "particles": b.edge**3,
        "steps": steps,
        "repeats": repeats,
        "iterations_per_step": ITERATIONS,
        "rollout": {"ms": 1e3 * forward / steps},
        "gradient": {"ms": 1e3 * backward / steps},
        "loss": float(loss),
        "centre_of_mass": [float(value) for value in end.x.mean(axis=0)],
        "density_error": float(checks.density_error[-1]),
        "longest_list": int(checks.neighbours.max()),
    }
    stats = device.memory_stats()
    if stats and "peak_bytes_in_use" in stats:
        row["gradient_bytes_per_particle"] = stats["peak_bytes_in_use"] / b.edge**3
    return row


def check(particles: int, steps: int) -> str:
    """The gradient beside central differences, in float64, where none of a few particles meets a wall or leaves it."""
    jax.config.update("jax_enable_x64", True)
    b, gravity, h = block(particles), jnp.array(GRAVITY), 1e-5
    found = with_gradient(gravity, b, steps)[1]
    differences = [
        (rollout(gravity.at[k].add(h), b, steps)[0] - rollout(gravity.at[k].add(-h), b, steps)[0]) / (2.0 * h)
        for k in range(3)
    ]
    return f"gradient    {np.asarray(found)}\ndifferences {np.asarray(differences)}"


def run_from(file: str, steps: int) -> None:
    """Go on from the velocities (n, 3) in a NumPy file, far from walls, and write positions and velocities there."""
    velocities = np.load(file)
    b = block(len(velocities), corner=1.0, box=(3.0, 3.0, 3.0))
    state = first_state(b)._replace(v=jnp.array(velocities))
    one = jax.jit(step, static_argnames="b")
    for _ in range(steps):
        state, _checks = one(state, jnp.array(GRAVITY), b)
    back = np.argsort(state.number)
    np.save(file, np.stack([np.asarray(state.x)[back] - b.corner, np.asarray(state.v)[back]]))


def main() -> None:
    parser = argparse.ArgumentParser(description="PCISPH in JAX, timed.")
    parser.add_argument("--particles", type=int, default=8000)
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--json", action="store_true", help="one line of JSON at the end")
    parser.add_argument("--check", action="store_true", help="the gradient beside finite differences")
    parser.add_argument("--run-from", metavar="FILE", help="run without walls from given velocities: see physics.py")
    given = parser.parse_args()
    if given.run_from:
        run_from(given.run_from, given.steps)
        return
    if given.check:
        print(check(given.particles, given.steps))
        return
    row = measure(given.particles, given.steps, given.repeats)
    print(json.dumps(row) if given.json else "\n".join(f"{name:30} {value}" for name, value in row.items()))


if __name__ == "__main__":
    main()
