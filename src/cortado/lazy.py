"""Names that are imported when they are first used, so that packages are quick to import, and of packages on top.

The core imports none of the packages that lie on top of it, which do pictures, films, exports, and pages for notebooks.
A method such as `Trajectory.film` asks for a function by its name, and only then the package is imported that has it.
"""

import importlib

TYPE_CHECKING = False  # that of typing, which takes as long to import as all of Cortado's first import
if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from typing import Any


def getter(package: str, homes: "Mapping[str, str] | None" = None) -> "Callable[[str], Any]":
    """Return the ``__getattr__`` of a package, which finds its modules, and the names in ``homes``, each with the
    module that has it: one within the package, or anywhere in Cortado if it begins with ``cortado.``."""

    def found(name: str) -> "Any":
        if homes and name in homes:
            home = homes[name]
            return getattr(importlib.import_module(home if home.startswith("cortado.") else f"{package}.{home}"), name)
        module = f"{package}.{name}"
        if not name.startswith("__"):
            try:
                return importlib.import_module(module)
            except ModuleNotFoundError as error:
                if error.name != module:
                    raise
        raise AttributeError(f"module {package!r} has no attribute {name!r}")

    return found


FUNCTIONS = {
    "export": "pictures.export_formats",
    "film_page": "pictures.pages",
    "fit_page": "optimisation.fitting.figures",
    "labelled": "pictures.export_formats",
    "result_page": "pictures.pages",
    "simulation_film": "pictures.run_pictures",
    "simulation_page": "pictures.pages",
    "simulation_picture": "pictures.run_pictures",
    "trajectory_film": "pictures.run_pictures",
    "trajectory_page": "pictures.pages",
    "trajectory_picture": "pictures.run_pictures",
}
"""Modules within `cortado` by the function that each has."""


def on_top(name: str) -> "Any":
    """Return the function of a name, one of `FUNCTIONS`."""
    return getattr(importlib.import_module(f"cortado.{FUNCTIONS[name]}"), name)
