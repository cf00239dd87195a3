"""``cortado schema``: the JSON schema of scenes and tasks, with which editors complete and check them."""

from cortado.optimisation.inverse.file_schema import file_schema_text


def print_schema() -> str:
    """As JSON."""
    return file_schema_text().rstrip("\n")
