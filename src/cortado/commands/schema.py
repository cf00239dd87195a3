"""``cortado schema``: the JSON schema of scenes and tasks, with which editors complete and check them."""

from cortado.io.shipped import SCHEMA


def print_schema() -> str:
    """As JSON."""
    return SCHEMA.read_text("utf-8").rstrip("\n")
