"""A trajectory as a dataset of xarray, whose dimensions and units have names."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from cortado.errors import ExtraMissingError
from cortado.runs.frame_file import FRACTION
from cortado.runs.solid_motion import SolidMotion
from cortado.runs.trajectory import Trajectory
from cortado.scene.quantities import QUANTITIES
from cortado.version import __version__

AXES = ["x", "y", "z"]
Variables = dict[str, tuple[tuple[str, ...], Any, dict[str, str]]]


def labelled(trajectory: Trajectory) -> Any:
    """See `Trajectory.to_xarray`."""
    try:
        import xarray
    except ImportError as error:
        raise ExtraMissingError("xarray", "xarray") from error
    axes, of_particles = AXES[: trajectory.dimension], ("time", "particle")
    variables: Variables = {
        "position": ((*of_particles, "space"), trajectory.positions, {"units": "m"}),
        "velocity": ((*of_particles, "space"), trajectory.velocities, {"units": "m/s"}),
    }
    if trajectory.mass_fractions is not None:
        variables[FRACTION.rstrip("_")] = ((*of_particles, "phase"), trajectory.mass_fractions, {"units": "1"})
    if "reference_density" in trajectory.constants:
        variables["reference_density"] = (("particle",), trajectory.constants["reference_density"], {"units": "kg/m3"})
    for name, values in trajectory.quantities.items():
        behind = {2: (), 3: ("space",)}[values.ndim]
        variables[name] = ((*of_particles, *behind), values, {"units": QUANTITIES[name].unit})
    coordinates: dict[str, Any] = {
        "time": ("time", trajectory.times, {"units": "s"}),
        "step": ("time", trajectory.steps, {"units": "1"}),
        "space": ("space", axes),
    }
    if trajectory.solids:
        coordinates |= {"solid": ("solid", list(trajectory.solids))}
        coordinates |= {"rotation_axis": ("rotation_axis", axes)} if trajectory.dimension == 3 else {}
        variables |= _of_solids(trajectory.solids, ("rotation_axis",) if trajectory.dimension == 3 else ())
    attributes: dict[str, Any] = {"source": f"Cortado {__version__}"}
    if trajectory.origin is not None:
        attributes["spacing"] = trajectory.origin.spacing
        attributes["spacing_units"] = "m"
    return xarray.Dataset(variables, coordinates, attributes)


def _of_solids(solids: Mapping[str, SolidMotion], turned: tuple[str, ...]) -> Variables:
    """Of solids that move, one behind the other; velocities of those that are told where to go are no numbers."""

    def stacked(each: list[Any], alike: list[Any]) -> Any:
        rows = [np.full_like(as_, np.nan) if one is None else one for one, as_ in zip(each, alike, strict=True)]
        return np.stack(rows, axis=1)

    every = list(solids.values())
    places, turns = [one.positions for one in every], [one.rotations for one in every]
    own, spins = [one.velocities for one in every], [one.angular_velocities for one in every]
    at = ("time", "solid")
    return {
        "solid_position": ((*at, "space"), stacked(places, places), {"units": "m"}),
        "solid_scale": (("solid",), [one.scale for one in every], {"units": "1"}),
        "solid_rotation": ((*at, *turned), stacked(turns, turns), {"units": "rad"}),
        "solid_velocity": ((*at, "space"), stacked(own, places), {"units": "m/s"}),
        "solid_angular_velocity": ((*at, *turned), stacked(spins, turns), {"units": "rad/s"}),
    }
