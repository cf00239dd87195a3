"""Names of a package that are imported when they are first used, so that the package itself is quick to import."""

import importlib

TYPE_CHECKING = False  # that of typing, which takes as long to import as all of Cortado's first import
if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from typing import Any


def getter(package: str, homes: "Mapping[str, str] | None" = None) -> "Callable[[str], Any]":
    """The ``__getattr__`` of a package, which finds its modules, and the names in ``homes``, each with the module that
    has it: one within the package, or anywhere in Cortado if it begins with ``cortado.``."""

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
