"""Files that come with Cortado: the examples, and the JSON schema of scenes and tasks."""

from pathlib import Path

_PACKAGE = Path(__file__).parents[1]
SCHEMA = _PACKAGE / "scene.schema.json"


def examples_folder() -> Path:
    """In the package where a wheel was installed; of an editable install in the repository."""
    installed = _PACKAGE / "examples"
    return installed if installed.is_dir() else _PACKAGE.parents[1] / "examples"
