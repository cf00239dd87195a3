"""Write equations as MathML, which browsers draw without a script or a network."""

import re
from typing import Any

from docutils import nodes
from latex2mathml.converter import convert

_BAR = "<mo>&#x0007C;</mo>"
_BARS = {
    r"\lvert": '<mo form="prefix" stretchy="false" lspace="0" rspace="0">&#x0007C;</mo>',
    r"\rvert": '<mo form="postfix" stretchy="false" lspace="0" rspace="0">&#x0007C;</mo>',
}
_PRIMED = re.compile(r"<msup>(<mi>[^<]*</mi>)<mi>(&#x0203[234];)</mi></msup>")


def mathml(text: str, display: str) -> str:
    """Convert a LaTeX formula to MathML."""
    # What is over a letter is an accent, such as a bar, and as large as the letter.
    found = convert(text, display=display).replace("<mover>", '<mover accent="true">')
    # Primes are raised already; as superscripts they would be too small to see.
    found = _PRIMED.sub(r'<mrow>\1<mo lspace="0" rspace="0">\2</mo></mrow>', found)
    # The converter writes both bars alike; inside of a formula they would be relations, with room on both sides.
    bars = iter(re.findall(r"\\[lr]vert", text))
    return re.sub(re.escape(_BAR), lambda _: _BARS[next(bars)], found)


def _write(writer: Any, node: nodes.Node, display: str) -> None:
    writer.body.append(mathml(node.astext(), display))
    raise nodes.SkipNode


def _inline(writer: Any, node: nodes.Node) -> None:
    _write(writer, node, "inline")


def _block(writer: Any, node: nodes.Node) -> None:
    _write(writer, node, "block")


def setup(app: Any) -> dict[str, bool]:
    app.add_html_math_renderer("mathml", (_inline, None), (_block, None))
    app.connect("config-inited", lambda app, config: setattr(config, "html_math_renderer", "mathml"))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
