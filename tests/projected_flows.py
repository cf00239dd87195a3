"""Flows that a fluid has to be pulled in, without walls or with."""

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from cortado import Scene, Simulation

C2 = {"kernel": "wendland_c2", "support": 2.6}
PROJECTION: dict[str, object] = {}
"""The solver of a scene that names none."""


def simulated(spacing, dimension=2, precision="float64", discretisation=C2, solver=PROJECTION, device="cpu", **tables):
    """Of water without viscosity and gravity in empty space, if nothing else is said."""
    given = {
        "phase": [{"name": "water", "rest_density": 1000.0, "viscosity": 0.0}],
        "container": {"shape": "none"},
        "forces": {"gravity": [0.0] * dimension},
        **tables,
        "solver": solver,
    }
    scene = Scene(dimension=dimension, discretisation={"spacing": spacing, **discretisation}, **given)
    return Simulation(scene, device, precision)


def box(lower, upper):
    return {"shape": "box", "lower": lower, "upper": upper, "phase": "water"}


def taylor_green(across, reynolds, time=1.0, pressure=True, solver=PROJECTION):
    """Greatest error of the energy over the first energy, and the relative error of the last velocities."""
    spacing, nu, k = 1.0 / across, 1.0 / reynolds, 2.0 * np.pi
    steps = int(np.ceil(time / min(0.2 * spacing, 0.1 * spacing**2 * reynolds)))
    simulation = simulated(
        spacing,
        phase=[{"name": "water", "rest_density": 1.0, "viscosity": nu}],
        fluid=[box([0.0, 0.0], [1.0, 1.0])],
        container={"shape": "box", "lower": [0.0, 0.0], "upper": [1.0, 1.0], "periodic": [True, True]},
        forces={"gravity": [0.0, 0.0], "viscosity": "stress", "pressure": pressure},
        solver={**solver, "time_step": time / steps},
    )

    def exact(x):
        a, b = k * x[:, 0], k * x[:, 1]
        return np.stack([-np.cos(a) * np.sin(b), np.sin(a) * np.cos(b)], axis=1)

    first = {"initial_velocities": exact(simulation.positions)}
    run = simulation.run(steps, first, record_every=max(steps // 40, 1))
    energy = (run.velocities**2).sum((1, 2)) / (run.velocities[0] ** 2).sum()
    decay = np.exp(-2.0 * nu * k**2 * run.times)
    wanted = decay[-1] * exact(run.positions[-1])
    velocity = np.linalg.norm(run.velocities[-1] - wanted) / np.linalg.norm(wanted)
    return np.abs(energy - decay**2).max(), velocity


def pieces(x, reach):
    """(n,) the number of the piece of each particle, of the pieces that particles within reach of one another form."""
    pairs = cKDTree(x).query_pairs(reach, output_type="ndarray")
    joined = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(x), len(x)))
    return connected_components(joined, directed=False)[1]


def rotating_patch(across, device="cpu"):
    """A square of side 1 that turns with 1 / s for 2 s: its pieces, the radius of its corners, energy and angular
    momentum over the first, and how many spacings the particles within 0.3 of the middle are from the nearest other."""
    spacing = 1.0 / across
    steps = int(np.ceil(2.0 / (0.15 * spacing / 0.7)))
    square, timed = [box([0.0, 0.0], [1.0, 1.0])], {**PROJECTION, "time_step": 2.0 / steps}
    simulation = simulated(spacing, fluid=square, solver=timed, device=device)
    c = simulation.positions - 0.5
    run = simulation.run(steps, {"initial_velocities": np.stack([c[:, 1], -c[:, 0]], axis=1)}, record_every=steps)
    x, v = run.positions[-1] - run.positions[-1].mean(0), run.velocities[-1]
    turning = (x[:, 0] * v[:, 1] - x[:, 1] * v[:, 0]).sum() / -(c**2).sum()
    radius = np.sort(np.linalg.norm(x, axis=1))[-4:].mean()
    nearest = cKDTree(x).query(x[np.linalg.norm(x, axis=1) < 0.3], k=2)[0][:, 1].mean() / spacing
    return pieces(x, 2.0 * spacing).max() + 1, radius, (v**2).sum() / (c**2).sum(), turning, nearest


def elliptical_drop(across, dimension=2, solver=PROJECTION, device="cpu"):
    """A ball of radius 1 that is drawn out along its last axis with 100 / s, in space with 200 / s (Monaghan 1994): its
    half axes over the exact ones, by second moments."""
    spacing, steps, others = 2.0 / across, 190, dimension - 1
    ball = {"shape": "sphere", "centre": [0.0] * dimension, "radius": 1.0, "phase": "water"}
    timed = {**solver, "time_step": 0.0076 / steps}
    simulation = simulated(spacing, dimension, fluid=[ball], solver=timed, device=device)
    x, rates = simulation.positions, np.array([-1.0] * others + [others])
    run = simulation.run(steps, {"initial_velocities": 100.0 * x * rates}, record_every=steps)
    a, c, rate, pieces_of_time = 1.0, 1.0, 100.0, 20_000
    for _ in range(pieces_of_time):
        h = 0.0076 / pieces_of_time
        change = rate**2 * (a**2 - others**2 * c**2) / (a**2 + others * c**2)
        a, c, rate = a - h * a * rate, c + h * others * c * rate, rate + h * change
    spread = np.sqrt((run.positions[-1] ** 2).mean(0) / (x**2).mean(0))
    return spread / np.array([a] * others + [c])


def oblique_wave():
    """A wave of shear of 0.5 m/s along the diagonal of a full periodic box of 1 x 0.6: its amplitude over the first,
    and what it should be."""
    spacing, nu, size = 1.0 / 30, 0.01, np.array([1.0, 0.6])
    k = 2.0 * np.pi / size
    along = np.array([-k[1], k[0]]) / np.linalg.norm(k)
    steps = int(np.ceil(0.4 / (0.2 * spacing)))
    simulation = simulated(
        spacing,
        phase=[{"name": "water", "rest_density": 1.0, "viscosity": nu}],
        fluid=[box([0.0, 0.0], size.tolist())],
        container={"shape": "box", "lower": [0.0, 0.0], "upper": size.tolist(), "periodic": [True, True]},
        solver={**PROJECTION, "time_step": 0.4 / steps},
    )

    def amplitude(x, v):
        return 2.0 * float((np.cos(x @ k) * (v @ along)).mean())

    x = simulation.positions
    v = 0.5 * np.cos(x @ k)[:, None] * along
    run = simulation.run(steps, {"initial_velocities": v}, record_every=steps)
    first, last = (amplitude(run.positions[n], run.velocities[n]) for n in (0, -1))
    return last / first, float(np.exp(-nu * k @ k * 0.4))


def hung_block():
    """A block that hangs under the lid of a box: how far it has fallen after 0.2 s over g t (t + dt) / 2, the fall of a
    point in steps that take the velocity first."""
    simulation = simulated(
        0.05,
        fluid=[box([0.3, 0.6], [0.7, 1.0])],
        container={"shape": "box", "lower": [0.0, 0.0], "upper": [1.0, 1.0]},
        forces={"gravity": [0.0, -9.81]},
        solver={**PROJECTION, "time_step": 0.002},
    )
    x = simulation.run(100, record_every=100).positions
    return (x[0] - x[-1])[:, 1].mean() / (0.5 * 9.81 * 0.2 * 0.202)


def dam_break(solver=PROJECTION, time_step=0.002, time=1.2, across=20, dimension=2):
    """Greatest energy over the first; means over particles and time: the compression, that of the density averaged over
    neighbours twice, that as the last repair or iteration finds it, and the part of particles that are nearer than half
    a spacing to another."""
    room, last = [3.0, 2.0, 0.3][:dimension], [1.0, 1.0, 0.3][:dimension]
    simulation = simulated(
        1.0 / across,
        dimension,
        fluid=[box([0.0] * dimension, last)],
        container={"shape": "box", "lower": [0.0] * dimension, "upper": room},
        forces={"gravity": [0.0, -9.81, 0.0][:dimension]},
        solver={**solver, "time_step": time_step},
    )
    run = simulation.run(round(time / time_step), record_every=10, record=["density"])
    energy = 0.5 * (run.velocities**2).sum((1, 2)) + 9.81 * run.positions[:, :, 1].sum(1)
    excess, near, smooth = run.quantities["density"] / 1000.0 - 1.0, [], []
    for x, error in zip(run.positions, excess, strict=True):
        tree = cKDTree(x)
        near.append((tree.query(x, k=2)[0][:, 1] < 0.5 / across).mean())
        close = tree.sparse_distance_matrix(tree, 2.6 / across, output_type="coo_matrix")  # with each one itself
        close.data = (1.0 - close.data * across / 2.6) ** 2
        for _ in range(2):
            error = close @ error / (close @ np.ones(len(x)))
        smooth.append(np.maximum(error, 0.0).mean())
    found = np.maximum(excess, 0.0).mean(), np.mean(smooth), run.diagnostics["density_errors"].mean(), np.mean(near)
    return energy.max() / energy[0], *found
