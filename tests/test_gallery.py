"""The films of the gallery: their scenes can be read with the values that they are filmed with, and their files are
small enough for a page."""

import importlib.util
import re
from pathlib import Path

from cortado.scene.scene import load_scene

ROOT = Path(__file__).parents[1]
PAGE, FILMS = ROOT / "docs/gallery.md", ROOT / "docs/images/films"


def entries():
    spec = importlib.util.spec_from_file_location("gallery", ROOT / "docs/site/gallery.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.ENTRIES


def test_every_scene_takes_its_values():
    for entry in (one for one in entries().values() if one.values):
        scene = load_scene(entry.scene, [*entry.values, f"discretisation.spacing={entry.spacing}"])
        assert scene.discretisation.spacing == entry.spacing


def test_what_is_on_the_page_can_be_made_and_is_there():
    text = PAGE.read_text("utf-8")
    named, shown = re.findall(r"gallery\.py --only (\w+)", text), re.findall(r"films/(\w+)\.webp", text)
    assert named == shown and set(named) <= set(entries()) and len(named) >= 13
    sizes = [(FILMS / f"{name}.webp").stat().st_size for name in named]
    assert max(sizes) < 650_000 and sum(sizes) < 12_000_000
    assert all((FILMS / f"{name}.jpg").exists() for name in named)
