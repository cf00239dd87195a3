"""Notebooks run in a small form, have no outputs, and show what ends a cell."""

import json
from pathlib import Path

import matplotlib.pyplot
import pytest

from compiling_notice import without_compiling

BOOKS = {path.stem: path for path in sorted((Path(__file__).parents[1] / "docs" / "notebooks").glob("*.ipynb"))}


def cells(name):
    return json.loads(BOOKS[name].read_text(encoding="utf-8"))["cells"]


@pytest.mark.parametrize("name", BOOKS)
def test_a_notebook_is_kept_without_outputs(name):
    code = [cell for cell in cells(name) if cell["cell_type"] == "code"]
    assert code and not any(cell["outputs"] or cell["execution_count"] for cell in code)


@pytest.mark.parametrize("name", BOOKS)
def test_all_cells_run(name, monkeypatch, tmp_path):
    """One behind the other, without a kernel."""
    if name == "train_a_policy":
        pytest.importorskip("optax", reason="optax is not installed")
    monkeypatch.setenv("CORTADO_QUICK", "1")
    monkeypatch.setattr(matplotlib.pyplot, "show", matplotlib.pyplot.close)
    monkeypatch.chdir(tmp_path)
    code = ["".join(cell["source"]) for cell in cells(name) if cell["cell_type"] == "code"]
    exec(compile("\n".join(code), name, "exec"), {"__name__": "__main__"})
    matplotlib.pyplot.close("all")


def test_in_a_kernel_objects_are_shown(monkeypatch, tmp_path):
    """The first steps, as Jupyter runs them: particles, a film, a picture and the result of a search."""
    nbformat = pytest.importorskip("nbformat", reason="nbformat is not installed")
    client = pytest.importorskip("nbclient", reason="nbclient is not installed")
    monkeypatch.setenv("CORTADO_QUICK", "1")
    book = nbformat.read(BOOKS["first_steps"], as_version=4)
    client.NotebookClient(book, timeout=120, resources={"metadata": {"path": str(tmp_path)}}).execute()
    outputs = [output for cell in book.cells if cell.cell_type == "code" for output in cell.outputs]
    shown = [kind for output in outputs for kind in output.get("data", {})]
    assert shown.count("text/html") == 3 and shown.count("image/png") == 1
    said = "".join(output.text for output in outputs if output.get("name") == "stderr")  # a line may come in parts
    assert without_compiling(said) == ""
