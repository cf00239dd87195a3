"""Equations as MathML, which browsers draw themselves: the site needs no script, and no network, for them."""

from typing import Any

from docutils import nodes
from latex2mathml.converter import convert


def _write(writer: Any, node: nodes.Node, display: str) -> None:
    # What is over a letter is an accent, such as a bar, and as large as the letter.
    writer.body.append(convert(node.astext(), display=display).replace("<mover>", '<mover accent="true">'))
    raise nodes.SkipNode


def _inline(writer: Any, node: nodes.Node) -> None:
    _write(writer, node, "inline")


def _block(writer: Any, node: nodes.Node) -> None:
    _write(writer, node, "block")


def setup(app: Any) -> dict[str, bool]:
    app.add_html_math_renderer("mathml", (_inline, None), (_block, None))
    app.connect("config-inited", lambda app, config: setattr(config, "html_math_renderer", "mathml"))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
