"""Jets that gravity stretches, which keep together as long as fluid can be pulled."""

import numpy as np

from projected_flows import C2, PROJECTION, pieces, simulated

GRAVITY = 9.81
WIDTH = 0.014
"""Of the nozzle [m]."""
SPEED = 0.56
"""In the nozzle [m/s]."""
FASTER = (1.5, 2.0, 2.5, 3.0)
"""Over the speed in the nozzle, where the jet is measured."""
TIMES = {"inviscid": 5.0, "viscous": 7.0}
"""In SPEED / GRAVITY. A tip that falls freely passes the last of these depths at 2. In honey of 5 Pa s the first
particles, which nothing pulls from below, come as a blob: as much flows there as must, within 1 %, only from 4.5 on."""


def falling_jet(across, dimension, viscosity=0.0, solver=PROJECTION, device="cpu"):
    """A jet that falls out of a nozzle, so many particles wide: the width or radius over that of continuity where it is
    1.5, 2, 2.5 and 3 times as fast, the greatest gap along it in spacings, and the share of it in one piece, all of
    the last 3 / 10 of `TIMES` the speed in the nozzle over gravity."""
    spacing, down = WIDTH / across, np.eye(dimension)[-1]
    depth = (FASTER[-1] ** 2 - 1.0) * SPEED**2 / (2.0 * GRAVITY)
    time = TIMES["viscous" if viscosity else "inviscid"] * SPEED / GRAVITY
    step = 0.06 * spacing / SPEED
    if viscosity:
        step = min(step, 0.1 * spacing**2 / (viscosity / 1000.0))
    steps = int(np.ceil(time / step))
    opening = np.pi * WIDTH**2 / 4.0 if dimension == 3 else WIDTH
    jet = {"outlet": [0.0] * dimension, "direction": list(-down), "radius": 0.5 * WIDTH, "phase": "water"}
    jet |= {"length": SPEED * time * 1.05, "flow_rate": opening * SPEED}
    simulation = simulated(
        *(spacing, dimension, "float32", C2),
        phase=[{"name": "water", "rest_density": 1000.0, "viscosity": viscosity}],
        fluid=[],
        emitter=[jet],
        forces={"gravity": list(-GRAVITY * down)},
        solver={**solver, "time_step": time / steps},
        device=device,
    )
    run = simulation.run(steps, record_every=max(steps // 100, 1))
    late = run.times > 0.7 * time
    speed = -run.velocities[0, 0] @ down
    layer = run.positions[0][np.abs(run.positions[0] @ down - (run.positions[0] @ down).min()) < 0.1 * spacing]
    rows, gaps, joined = [], [], []
    for x, v in zip(run.positions[late], run.velocities[late], strict=True):
        out = (x @ down < 0.0) & (x @ down > -depth)
        heights = np.sort(x[(x @ down < 2.0 * spacing) & (x @ down > -depth)] @ down)
        gaps.append(np.diff(heights).max() / spacing)
        joined.append(np.bincount(pieces(x[out], 1.8 * spacing)).max() / out.sum())
        rows.append([_spread(x, v, down, speed, faster, spacing) for faster in FASTER])
    width, fall = np.nanmean(np.array(rows), axis=0).T
    whole = _size(layer[:, :-1], spacing)
    continuity = whole * (speed / fall) ** (1.0 / (dimension - 1))
    return width / continuity, float(np.max(gaps)), float(np.mean(joined))


def _spread(x, v, down, speed, faster, spacing):
    """The size of the jet where it is so much faster than at the nozzle, and its speed there."""
    at = -(faster**2 - 1.0) * speed**2 / (2.0 * GRAVITY)
    here = np.abs(x @ down - at) < 2.5 * spacing
    if here.sum() < 3:
        return np.nan, np.nan
    return _size(x[here][:, :-1], spacing), -(v[here] @ down).mean()


def _size(x, spacing):
    """The width of a row, or the radius of a disc, with the second moments of particles of a cell each."""
    moments = x.var(0).sum() + x.shape[1] * spacing**2 / 12.0
    return np.sqrt(12.0 * moments) if x.shape[1] == 1 else np.sqrt(2.0 * moments)
