"""Link names without a module in docstrings, such as `Problem`, to their description in the site."""

from typing import Any

from docutils import nodes
from sphinx.util.nodes import make_refnode


def _find(app: Any, env: Any, node: Any, content: nodes.Node) -> nodes.Node | None:
    if node.get("refdomain") != "py":
        return None
    end = "." + node["reftarget"].removeprefix("cortado.")
    objects = env.domains["py"].objects
    places = {(entry.docname, entry.node_id) for name, entry in objects.items() if name.endswith(end)}
    if len(places) != 1:
        return None
    page, anchor = places.pop()
    return make_refnode(app.builder, node["refdoc"], page, anchor, content)


def setup(app: Any) -> dict[str, bool]:
    app.connect("missing-reference", _find)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
