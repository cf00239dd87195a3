"""The scenes of the leaderboard: a new one is an entry in `SCENES`."""

from typing import Any

from cortado import Scene

PAINT = {"name": "paint", "rest_density": 1400.0, "viscosity": 0.2, "colour": [0.9, 0.3, 0.1]}


def dam(spacing: float, counts: tuple[int, ...], **tables: Any) -> dict[str, Any]:
    """A block of so many particles along each axis, beside as much empty space, which collapses under gravity.

    The spaces over and beside it are as large as the block. Time steps are 0.04 spacings over 1 m/s.
    """
    width, *others = (spacing * count for count in counts)
    height, *depth = others
    return {
        "name": "dam",
        "dimension": len(counts),
        "discretisation": {"spacing": spacing},
        "phase": [{"name": "water", "rest_density": 1000.0, "viscosity": 0.05}],
        "fluid": [{"shape": "box", "lower": [0.0] * len(counts), "upper": [width, height, *depth], "phase": "water"}],
        "container": {"shape": "box", "lower": [0.0] * len(counts), "upper": [2.0 * width, 2.0 * height, *depth]},
        "forces": {"gravity": [0.0, -9.81, *[0.0 for _ in depth]], "viscosity": "pairwise"},
        "solver": {"kind": "pcisph", "time_step": 0.04 * spacing, "minimum_iterations": 4, "maximum_iterations": 4},
        **tables,
    }


def with_kernel(name: str, support: float) -> dict[str, Any]:
    """The small dam in the plane with another smoothing kernel."""
    return dam(0.025, (12, 12), discretisation={"spacing": 0.025, "kernel": name, "support": support})


def projected(tables: dict[str, Any], **solver: Any) -> dict[str, Any]:
    """The same scene by the projection, whose own viscosity it has, and whose own kernel where it names none."""
    forces = {**tables["forces"], "viscosity": "stress"}
    own = {"kind": "projection", "time_step": tables["solver"]["time_step"], **solver}
    return {**tables, "forces": forces, "solver": own}


def two_fluids(spacing: float, counts: tuple[int, ...]) -> dict[str, Any]:
    """A dam whose right half is paint, heavier and more viscous."""
    one = dam(spacing, counts)
    block = one["fluid"][0]
    middle = spacing * (counts[0] // 2)
    left = {**block, "upper": [middle, *block["upper"][1:]]}
    right = {**block, "lower": [middle, *block["lower"][1:]], "phase": "paint"}
    mixture = {"mobility": 1e-3, "interface_width": 2.0 * spacing}
    return {**one, "phase": [*one["phase"], PAINT], "fluid": [left, right], "mixture": mixture}


def jet() -> dict[str, Any]:
    """Paint shot into a pool of water in the plane: 288 particles in the pool, 4 abreast in the jet."""
    return {
        **dam(0.025, (24, 12)),
        "phase": [*dam(0.025, (1, 1))["phase"], PAINT],
        "container": {"shape": "box", "lower": [0.0, 0.0], "upper": [0.6, 1.0]},
        "emitter": [{"phase": "paint", "outlet": [0.3, 0.4], "radius": 0.05, "length": 0.5, "flow_rate": 0.1}],
        "mixture": {"mobility": 1e-3, "interface_width": 0.05},
    }


def paddled(spacing: float) -> dict[str, Any]:
    """A pool in the plane, 0.6 m wide and 0.3 m deep, in whose middle a paddle is moved, a third of it deep."""
    counts = round(0.6 / spacing), round(0.3 / spacing)
    paddle = {"name": "paddle", "shape": "box", "lower": [0.25, 0.1], "upper": [0.35, 0.5], "motion": "path"}
    paddle["velocity"] = [0.0, 0.0]
    pool = {"shape": "box", "lower": [0.0, 0.0], "upper": [0.6, 0.3], "phase": "water"}
    container = {"shape": "box", "lower": [0.0, 0.0], "upper": [0.6, 1.0]}
    return dam(spacing, counts, fluid=[pool], container=container, solid=[paddle])


SCENES: dict[str, dict[str, Any]] = {
    "plane-144": dam(0.025, (12, 12)),
    "plane-144-wendland-c2": with_kernel("wendland_c2", 2.0),
    "plane-144-wendland-c4": with_kernel("wendland_c4", 2.4),
    "plane-144-two-fluids": two_fluids(0.025, (12, 12)),
    "plane-jet": jet(),
    "plane-paddle": paddled(0.025),
    "plane-paddle-1024": paddled(0.0125),
    "plane-576": dam(0.0125, (24, 24)),
    "plane-2304": dam(0.00625, (48, 48)),
    "plane-9216": dam(0.003125, (96, 96)),
    "space-1000": dam(0.05, (10, 10, 10)),
    "space-1000-two-fluids": two_fluids(0.05, (10, 10, 10)),
    "space-8000": dam(0.025, (20, 20, 20)),
    "plane-144-projection": projected(dam(0.025, (12, 12))),
    "plane-144-wendland-c2-2.6": with_kernel("wendland_c2", 2.6),
    "plane-144-projection-cubic-spline": projected(with_kernel("cubic_spline", 2.0)),
    "plane-paddle-projection": projected(paddled(0.025)),
    "plane-paddle-projection-4-iterations": projected(paddled(0.025), iterations=4),
    "plane-paddle-1024-projection": projected(paddled(0.0125)),
    "plane-576-projection": projected(dam(0.0125, (24, 24))),
    "space-1000-projection": projected(dam(0.05, (10, 10, 10))),
    "space-8000-projection": projected(dam(0.025, (20, 20, 20))),
}
"""By name the tables of each scene."""


def scene(name: str) -> Scene:
    """The scene of that name."""
    return Scene(**SCENES[name])
