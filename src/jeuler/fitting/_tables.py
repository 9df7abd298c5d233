"""Fits as tables for a notebook and for a terminal: each parameter with its unit and standard error."""

from __future__ import annotations

import re
from typing import Any

import jax
import numpy as np

from jeuler._core.describe import object_table, summary, table, text_table, values_of
from jeuler.fitting.unknowns import readable

UNITS = {
    "ks": "N/m",
    "kd": "N s/m",
    "rest_length": "m",
    "mass": "kg",
    "velocity": "m/s",
    "position": "m",
    "anchors": "m",
    "acceleration": "m/s^2",
    "radius": "m",
}
MOST_ROWS = 20


def unit_of(name: str, scene: Any = None) -> str:
    """The unit of a parameter of a scene: of ``mass``, or of ``forces[1].ks[0]``; empty where it is not known."""
    *_, field = re.sub(r"(\[[\d, ]+\])+$", "", name).split(".")
    if field == "coefficient" and scene is not None:
        number = re.match(r"forces\[(\d+)\]", name)
        forces = [scene.forces[int(number[1])]] if number else scene.forces
        kinds = {type(force).__name__ for force in forces if hasattr(force, "coefficient")}
        return {frozenset({"LinearDrag"}): "kg/s", frozenset({"QuadraticDrag"}): "kg/m"}.get(frozenset(kinds), "")
    return UNITS.get(field, "")


def parameter_rows(params: Any, stderr: Any, unit: Any = lambda name: "") -> list[tuple[str, str, str, str]]:
    """(name, value, standard error, unit) of each leaf of the parameters; of an array, the range of its values."""
    leaves = jax.tree_util.tree_leaves_with_path(params)
    errors = [None] * len(leaves) if stderr is None else jax.tree.leaves(stderr)
    rows = []
    for (path, value), error in zip(leaves, errors, strict=True):
        name, shown = readable(path), "" if error is None else values_of(np.asarray(error))
        rows.append((name, values_of(np.asarray(value)), shown, unit(name)))
    return rows


def fit_table(found: Any) -> str:
    """A `Fit` or `SpringFit`: parameters with standard errors (and units, of a scene), the loss, and what happened."""
    return table(*_fit(found)) if _is_one(found) else object_table(found)


def fit_text(found: Any) -> str:
    """The same for a terminal."""
    return text_table(*_fit(found)) if _is_one(found) else summary(found)


def _is_one(found: Any) -> bool:
    """Whether this is one fit with its numbers, and neither a batch of fits nor one that is being traced."""
    traced = any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves((found.params, found.loss)))
    return not traced and np.ndim(found.loss) == 0


def _fit(found: Any) -> tuple[str, list[tuple[str, ...]], tuple[str, ...], str]:
    scene = getattr(found, "scene", None)
    rows = parameter_rows(found.params, found.stderr, lambda name: "" if scene is None else unit_of(name, scene))
    more = [(f"... {len(rows) - MOST_ROWS} more", "", "", "")] if len(rows) > MOST_ROWS else []
    loss = f"loss {found.loss:.4g}{'' if scene is None else ' m^2'} after {len(found.history)} iterations"
    head = ("parameter", "value", "standard error", "unit")
    return type(found).__name__, [*rows[:MOST_ROWS], *more], head, f"{loss}; {found.message}"


def identifiability_text(asked: Any) -> str:
    """An `Identifiability` for a terminal: the standard error that each parameter would have."""
    rows = [(name, error, unit) for name, error, _, unit in parameter_rows(asked.stderr, None, unit_of)]
    return text_table("Identifiability", rows, ("parameter", "standard error", "unit"), asked.message)


def springs_text(found: Any) -> str:
    """A `FoundSprings` for a terminal: each spring with its standard errors."""
    names = ("ks", "kd", "rest_length")
    columns = [(getattr(found, name), found.stderr[name]) for name in names]
    values = [[f"{v:.5g} +- {e:.2g}" for v, e in zip(*column, strict=True)] for column in columns]
    rows = [(f"{i} - {j}", *row) for (i, j), *row in zip(found.edges, *values, strict=True)]
    head = ("particles", "ks, N/m", "kd, N s/m", "rest length, m")
    return text_table("FoundSprings", rows, head, found.message)
