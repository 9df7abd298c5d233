"""Fits as tables for a notebook: each parameter with its unit and standard error."""

from __future__ import annotations

import re
from typing import Any

import jax
import numpy as np

from jeuler._core.describe import table, values_of

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
    """The unit of a parameter of a scene: of ``mass``, or of ``forces[1].ks``; empty where it is not known."""
    *_, field = name.split(".")
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
        name = jax.tree_util.keystr(path)
        name = path[0].key if len(path) == 1 and isinstance(path[0], jax.tree_util.DictKey) else name or "parameter"
        shown = "" if error is None else values_of(np.asarray(error))
        rows.append((str(name), values_of(np.asarray(value)), shown, unit(str(name))))
    return rows


def fit_table(found: Any) -> str:
    """A `Fit` or `SpringFit`: parameters with standard errors (and units, of a scene), the loss, and what happened."""
    scene = getattr(found, "scene", None)
    rows = parameter_rows(found.params, found.stderr, lambda name: "" if scene is None else unit_of(name, scene))
    more = [(f"... {len(rows) - MOST_ROWS} more", "", "", "")] if len(rows) > MOST_ROWS else []
    loss = f"loss {found.loss:.4g}{'' if scene is None else ' m^2'} after {len(found.history)} iterations"
    head = ("parameter", "value", "standard error", "unit")
    return table(type(found).__name__, [*rows[:MOST_ROWS], *more], head, f"{loss}; {found.message}")
