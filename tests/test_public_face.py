"""What a user sees who asks for the names of the package and of its public modules."""

import subprocess
import sys

import pytest

import cortado

MODULES = ("executors", "gradients", "image_losses", "losses", "optimisers", "pictures", "render")


@pytest.mark.parametrize("name", MODULES)
def test_a_public_module_shows_what_is_public_and_no_more(name):
    module = getattr(cortado, name)
    assert dir(module) == sorted(module.__all__) and len(set(module.__all__)) == len(module.__all__) >= 4
    for public in module.__all__:
        assert not public.startswith("_")
        home = getattr(getattr(module, public), "__module__", "cortado")
        assert home.startswith("cortado"), f"cortado.{name}.{public} is of {home}"


def test_the_package_shows_what_is_public_and_no_more():
    """Also before anything was used, and after all of it was."""
    names = dir(cortado)
    assert set(names) == {*cortado.__all__, "__version__"} and {"Simulation", "optimise", *MODULES} <= set(names)
    assert all(getattr(cortado, name) is not None for name in names)
    assert dir(cortado) == names
    program = "import cortado; print(*dir(cortado))"
    assert subprocess.run([sys.executable, "-c", program], capture_output=True, text=True).stdout.split() == names


def test_types_are_checked_where_cortado_is_used(tmp_path):
    """As the package says that it has types, and its names are found though they are imported late."""
    (tmp_path / "use.py").write_text(
        "import cortado\n"
        'trajectory = cortado.Simulation("scene.toml").run(3)\n'
        "reveal_type(trajectory[-1])\n"
        "reveal_type(trajectory[1:])\n"
        "cortado.Simulation(3)\n"
    )
    command = [sys.executable, "-m", "mypy", "--config-file=", "--follow-imports=silent", "use.py"]
    found = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True).stdout
    assert 'Revealed type is "cortado.io.trajectory.Frame"' in found
    assert 'Revealed type is "cortado.io.trajectory.Trajectory"' in found
    assert '"Simulation" has incompatible type "int"' in found
