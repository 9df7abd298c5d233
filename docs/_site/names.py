"""A page for the public names of each part of the library, made from it; and links to them wherever they stand.

A public name without a docstring or without an example is a warning, and so fails the build.
"""

from __future__ import annotations

import functools
import importlib
import inspect
import pathlib
from typing import Any

from docutils import nodes
from sphinx import addnodes
from sphinx.application import Sphinx
from sphinx.transforms import SphinxTransform
from sphinx.util import logging

import jeuler

LOG = logging.getLogger(__name__)
PARTS = {  # the order in which a reader needs them
    "solving": "Solving",
    "steps": "Steps",
    "particles": "Particles and scenes",
    "forces": "Forces",
    "effects": "Effects",
    "contact": "Contact",
    "meshes": "Bodies from meshes",
    "samplers": "Samplers",
    "fitting": "Fitting",
    "observing": "What sensors show",
    "accuracy": "Accuracy and cost",
    "diagnosis": "Finding faults",
    "plotting": "Figures and films",
    "scenes": "Example scenes",
}
WITH_METHODS = "solving", "particles", "fitting", "accuracy", "diagnosis", "plotting"


@functools.cache
def public_names() -> dict[str, dict[str, Any]]:
    """The public objects of each part, by the name under which a user finds them."""
    found: dict[str, dict[str, Any]] = {part: {} for part in PARTS}
    for name in jeuler.__all__:
        thing = getattr(jeuler, name)
        if not inspect.ismodule(thing) and name != "__version__":
            part = getattr(thing, "__module__", type(thing).__module__).split(".")[1]
            found.setdefault(part, {})[f"jeuler.{name}"] = thing
    for part in ("observing", "plotting", "scenes"):
        module = importlib.import_module(f"jeuler.{part}")
        found[part] = {f"jeuler.{part}.{name}": getattr(module, name) for name in dir(module) if name[0] != "_"}
    return found


def first_sentence(thing: Any) -> str:
    return (inspect.getdoc(thing) or "").split("\n\n")[0].replace("\n", " ").replace("|", "\\|")


def write_pages(app: Sphinx) -> None:
    """One page for each part, in ``api/``."""
    folder = pathlib.Path(app.srcdir, "api")
    folder.mkdir(exist_ok=True)
    for part, things in public_names().items():
        if part not in PARTS:
            LOG.warning("the public names of jeuler.%s are on no page: add it to docs/_site/names.py", part)
            continue
        text = [f"# {PARTS[part]}", "", "| name | what it is |", "|---|---|"]
        text += [f"| `{name}` | {first_sentence(thing)} |" for name, thing in things.items() if callable(thing)]
        for name, thing in things.items():
            if callable(thing):
                text += [
                    "",
                    f"## {name.rpartition('.')[2]}",
                    "",
                    "```{eval-rst}",
                    *_directive(part, name, thing),
                    "```",
                ]
                _check(name, thing)
        path = folder / f"{part}.md"
        page = "\n".join(text) + "\n"
        if not path.exists() or path.read_text() != page:
            path.write_text(page)
    index = ["# The names", "", "```{toctree}", ":maxdepth: 1", "", *PARTS, "```", ""]
    (folder / "index.md").write_text("\n".join(index))


def _directive(part: str, name: str, thing: Any) -> list[str]:
    if inspect.isclass(thing):
        return [f".. autoclass:: {name}", *(["   :members:"] if part in WITH_METHODS else [])]
    return [f".. autofunction:: {name}"] if inspect.isroutine(thing) else [f".. autodata:: {name}", "   :no-value:"]


def _check(name: str, thing: Any) -> None:
    text = inspect.getdoc(thing) or ""
    if not text:
        LOG.warning("%s has no docstring", name)
    elif ">>>" not in text and not name.startswith("jeuler.scenes."):  # these are examples themselves
        LOG.warning("%s has no example in its docstring", name)


class LinkNames(SphinxTransform):
    """Literals that are public names become links to their entries."""

    default_priority = 400

    def apply(self, **_: Any) -> None:
        known = {name for things in public_names().values() for name in things}
        for literal in list(self.document.findall(nodes.literal)):
            text = literal.astext().partition("(")[0]
            target = next(
                (t for t in (text, f"jeuler.{text}", f"jeuler.{text}".rpartition(".")[0]) if t in known), None
            )
            inside = isinstance(literal.parent, (nodes.reference, addnodes.pending_xref, nodes.title))
            if target and not inside:
                link = addnodes.pending_xref(
                    "", refdomain="py", reftype="obj", reftarget=target, refexplicit=True, refdoc=self.env.docname
                )
                literal.replace_self(link)
                link += literal


def setup(app: Sphinx) -> None:
    app.connect("builder-inited", write_pages)
    app.add_transform(LinkNames)
