"""What packages on top of the core do for its objects: pictures, films, exports, and pages for notebooks.

The core imports none of these packages. A method such as `Trajectory.film` asks for a function by its name, and only
then the package is imported that has it.
"""

from importlib import import_module
from typing import Any

FUNCTIONS = {
    "export": "pictures.exports.formats",
    "film_page": "pictures.notebook",
    "fit_page": "optimisation.fitting.figures",
    "labelled": "pictures.exports.formats",
    "result_page": "pictures.notebook",
    "simulation_film": "pictures.run_pictures",
    "simulation_page": "pictures.notebook",
    "simulation_picture": "pictures.run_pictures",
    "trajectory_film": "pictures.run_pictures",
    "trajectory_page": "pictures.notebook",
    "trajectory_picture": "pictures.run_pictures",
}
"""The modules that have them, within `cortado`."""


def on_top(name: str) -> Any:
    """The function of that name, one of `FUNCTIONS`."""
    return getattr(import_module(f"cortado.{FUNCTIONS[name]}"), name)
