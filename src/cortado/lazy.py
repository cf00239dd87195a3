"""Import names when they are first used, so that ``import cortado`` is quick."""

import importlib

TYPE_CHECKING = False  # that of typing, which takes as long to import as all of Cortado's first import
if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from typing import Any


def getter(package: str, homes: "Mapping[str, str] | None" = None) -> "Callable[[str], Any]":
    """Return a ``__getattr__`` that imports a package's modules, and names from the modules in ``homes``."""

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


_NAMES = {
    "optimisation.fitting.figures": "fit_page",
    "pictures.export_formats": "export labelled",
    "pictures.pages": "film_page result_page simulation_page trajectory_page",
    "pictures.run_pictures": "simulation_film simulation_picture trajectory_film trajectory_picture",
}
FUNCTIONS = {name: home for home, names in _NAMES.items() for name in names.split()}


def on_top(name: str) -> "Any":
    """Import and return a function of `FUNCTIONS`, from a package that is not a part of Cortado's core."""
    return getattr(importlib.import_module(f"cortado.{FUNCTIONS[name]}"), name)
