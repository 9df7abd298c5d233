"""The documentation site: ``python -m sphinx -W -n docs docs/_build/html`` builds it, without a network.

Sphinx, MyST and furo, since JAX's own documentation is made of the same and all three are kept up; Material for MkDocs,
the other usual choice, ends in May 2027. Pages are Markdown, those with code cells are run by the build.
"""

import os
import pathlib
import shutil
import sys

sys.path.insert(0, str(pathlib.Path(__file__).parent))

from _site import docstrings

import jeuler

HERE = pathlib.Path(__file__).parent
EXECUTED = os.environ.get("JEULER_EXECUTED_NOTEBOOKS")  # a folder of notebooks that the tests have run
LINKS = {"](../notebooks/": "](notebooks/", "](../CONTRIBUTING.md)": "](contributing.md)", "](../docs/": "](../"}

project = "jeuler"
author = "jeuler developers"
copyright = "jeuler developers"
version = release = jeuler.__version__

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx_copybutton", "sphinx_design", "_site.names"]
exclude_patterns = ["_build", "_site", "work_precision.md", "**/.ipynb_checkpoints"]  # included by accuracy.md
suppress_warnings = ["mystnb.unknown_mime_type"]
nitpicky = True

html_theme = "furo"
html_title = "jeuler"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_copy_source = False
html_theme_options = {"navigation_with_keys": True}

myst_enable_extensions = ["colon_fence", "deflist"]
myst_heading_anchors = 3
nb_execution_mode = "cache"
nb_execution_raise_on_error = True
nb_execution_timeout = 300
nb_execution_in_temp = True
nb_merge_streams = True
nb_execution_excludepatterns = ["notebooks/*"] if EXECUTED else []
copybutton_prompt_text = r">>> |\.\.\. |\$ "
copybutton_prompt_is_regexp = True

autodoc_typehints = "none"
autodoc_member_order = "bysource"
toc_object_entries = False


def copy_notebooks(app):
    """The notebooks beside the pages."""
    folder = HERE / "notebooks"
    folder.mkdir(exist_ok=True)
    for path in sorted((HERE.parent / "notebooks").glob("*.ipynb")):
        source = pathlib.Path(EXECUTED or path.parent, path.name)
        if not (folder / path.name).exists() or (folder / path.name).read_bytes() != source.read_bytes():
            shutil.copy(source, folder / path.name)


def links(app, docname, source):
    """Links of pages that are read in the repository too, as they are in the site."""
    for there, here in LINKS.items():
        source[0] = source[0].replace(there, here)


def docstring(app, what, name, thing, options, lines):
    lines[:] = docstrings.rst(lines)


def signature(app, what, name, thing, options, signature, returns):
    """Results are not made by hand: no signature."""
    if what == "class" and "Args:" not in (thing.__doc__ or ""):
        return "", None
    return None


def setup(app):
    app.connect("builder-inited", copy_notebooks)
    app.connect("source-read", links)
    app.connect("autodoc-process-docstring", docstring)
    app.connect("autodoc-process-signature", signature)
