"""Settings of the documentation site: `make docs` builds it without a network."""

from __future__ import annotations

import hashlib
import os
import shutil
import sys
from ctypes.util import find_library
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
sys.path[:0] = [str(HERE), str(ROOT)]

import generate
from docutils import nodes

from slipid import __version__

project = "slipid"
author = "the authors of slipid"
copyright = "the authors of slipid, Apache-2.0"
release = version = __version__

extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.mathjax",
    "myst_nb",
    "sphinx_copybutton",
    "sphinx_design",
]
exclude_patterns = ["_build", "results/*.json", "jupyter_execute"]
root_doc = "index"
nitpicky = True
nitpick_ignore_regex = [
    # types of numpy, jax and the standard library, which have their own sites
    ("py:.*", r"(?!slipid\b).*"),
    # bases and helpers that are not public
    ("py:.*", r"slipid\..*\..*"),
]

myst_enable_extensions = ["dollarmath", "colon_fence", "deflist", "attrs_inline"]
myst_heading_anchors = 4
smartquotes = False
# docstrings write names of code between single backticks
default_role = "code"
autodoc_typehints = "none"
autodoc_member_order = "bysource"
napoleon_numpy_docstring = False
napoleon_use_ivar = True

# Notebooks of the tutorials run when the site is built; the lessons are run by the test suite.
nb_execution_mode = os.environ.get("SLIPID_DOCS_EXECUTE", "cache")
# What they printed is kept for these sources of slipid: other sources run them again.
SOURCES = [*sorted((ROOT / "slipid").rglob("*.py")), HERE / "_ipython" / "commands.py"]
STATE = hashlib.sha256(b"".join(path.read_bytes() for path in SOURCES)).hexdigest()[:12]
nb_execution_cache_path = str(ROOT / ".cache" / "docs-notebooks" / STATE)
nb_execution_excludepatterns = ["lessons/*"]
if find_library("EGL"):
    os.environ.setdefault("MUJOCO_GL", "egl")  # films without a screen
else:
    nb_execution_excludepatterns.append("tutorials/omni_camera*")
nb_execution_raise_on_error = True
nb_execution_timeout = 600
nb_execution_show_tb = True
nb_execution_in_temp = True

html_theme = "furo"
html_title = f"slipid {version}"
html_static_path = ["_static"]
html_css_files = ["slipid.css"]
html_copy_source = False
html_show_sourcelink = False
linkcheck_ignore = [r"https?://.*"]
copybutton_prompt_text = r"\$ "


def setup(app) -> None:
    """Connect the generated parts to the build."""
    # what the notebooks run: this Python's commands, plain text of one width
    os.environ["PATH"] = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    os.environ |= {"COLUMNS": "100", "IPYTHONDIR": str(_plain_ipython())}
    lessons = HERE / "lessons"
    lessons.mkdir(exist_ok=True)
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        target = lessons / path.name
        if not target.exists() or target.read_bytes() != path.read_bytes():
            shutil.copy(path, target)
    generate.schemas(HERE / "_static" / "schemas")
    app.connect("source-read", _expand)
    app.connect("doctree-read", _plain_commands)


def _plain_ipython() -> Path:
    """Return a settings folder with what notebooks run first; IPython writes its history there."""
    folder = ROOT / ".cache" / "docs-ipython"
    startup = folder / "profile_default" / "startup"
    startup.mkdir(parents=True, exist_ok=True)
    shutil.copy(HERE / "_ipython" / "commands.py", startup)
    return folder


def _expand(app, name: str, source: list[str]) -> None:
    before = source[0]
    source[0] = generate.expand(before)
    if source[0] != before:
        for path in generate.RESULTS.glob("*.json"):
            app.env.note_dependency(str(path), docname=name)


def _plain_commands(app, doctree) -> None:
    """Show a cell of commands as commands, without the line that makes the notebook run them."""
    for node in doctree.findall(nodes.literal_block):
        if node.rawsource.startswith("%%sh\n"):
            text = node.rawsource.removeprefix("%%sh\n")
            node.rawsource, node["language"] = text, "sh"
            node.children = [nodes.Text(text)]
