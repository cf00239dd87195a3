"""The table of parameters in Markdown, which ``python docs/site/parameter_table.py`` prints."""

from cortado.scene.parameters import PARAMETERS, Axis, Parameter

HEAD = "| parameter | shape | unit | | range |\n|---|---|---|---|---|\n"


def markdown() -> str:
    """Return a Markdown table with a row for each parameter. Shapes contain n particles and d dimensions."""
    return HEAD + "".join(_row(parameter) for parameter in PARAMETERS)


def _row(parameter: Parameter) -> str:
    allowed = "" if parameter.range.value == "any" else parameter.range.value
    return f"| `{parameter.name}` | {_shape(parameter)} | {parameter.unit} | {parameter.meaning} | {allowed} |\n"


def _shape(parameter: Parameter) -> str:
    if parameter.axis is Axis.SCALAR:
        return "a number"
    components = parameter.components
    if components is None:
        return "a number; (phases,) of several"
    own = {(2, 3): "d", (1, 2): "d - 1", (7, 7): "phases", (3, 3): "3"}[components(2, 7), components(3, 7)]
    if parameter.axis is Axis.STEP:
        return f"({own},) or (steps, {own})"
    return f"({'n' if parameter.axis is Axis.PARTICLE else 'phases'}, {own})"


if __name__ == "__main__":
    print(markdown(), end="")
