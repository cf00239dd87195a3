"""Settings of Sphinx, which builds the site from this folder: `make docs`."""

import logging
import os
import sys
from hashlib import sha256
from importlib.util import find_spec
from pathlib import Path

import cortado

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE / "site"))

project = "Cortado"
author = "the Cortado authors"
copyright = "2026, the Cortado authors"
release = version = cortado.__version__

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
    "mathml",  # of the folder site/, as the next two
    "outer_pages",
    "short_names",
]
exclude_patterns = ["site"]

# ---- pages in Markdown --------------------------------------------------------------------------------------------
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 4

# ---- tutorials, which are executed --------------------------------------------------------------------------------
highlight_language = "none"  # what is indented is an equation or a command
nb_execution_mode = "cache"  # what was executed stays until a cell, or the package, is another
sources = sorted(Path(cortado.__file__).parent.rglob("*.py"))
digest = sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()[:16]
nb_execution_cache_path = str(HERE.parent / "build" / "executed" / digest)
nb_execution_timeout = 300
nb_execution_excludepatterns = ["*train_a_policy.ipynb"]  # ten minutes
nb_execution_raise_on_error = True
nb_merge_streams = True
# Kernels of notebooks warn of how they are reached, on this machine alone, and their client tells of each.
profile = HERE.parent / "build" / "ipython" / "profile_default"
profile.mkdir(parents=True, exist_ok=True)
(profile / "ipython_kernel_config.py").write_text("get_config().IPKernelApp.log_level = 40\n", encoding="utf-8")
os.environ["IPYTHONDIR"] = str(profile.parent)
logging.getLogger("traitlets").setLevel(logging.WARNING)
nb_output_stderr = "remove"  # it says which kernels are compiled, where none are yet

# ---- the API, from docstrings -------------------------------------------------------------------------------------
autoclass_content = "both"
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_preserve_defaults = True
autodoc_mock_imports = [name for name in ("torch",) if find_spec(name) is None]  # it is optional, and large
napoleon_numpy_docstring = False
default_role = "py:obj"
add_module_names = False
python_maximum_signature_line_length = 80

# ---- HTML ---------------------------------------------------------------------------------------------------------
html_theme = "furo"
html_title = f"Cortado {release}"
html_static_path = ["site/static"]
html_css_files = ["site.css"]
html_domain_indices = False  # the genindex has the same
html_show_sourcelink = False
linkcheck_ignore = [r"http://localhost.*"]
