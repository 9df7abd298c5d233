"""The error of one number that a fit determines."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jeuler._core import checks
from jeuler.fitting.asked import ASKED
from jeuler.fitting.beside import attached
from jeuler.fitting.unknowns import Layout

BLIND = "blind directions"  # under this name those of the params, (n, k), are kept beside a result
SEEN = 1e-5  # of a change along one of them: less is rounding


def error_of(found: Any, of: str | Callable[[Any], Any]) -> float:
    """The standard error of a parameter by name, or of a function of the params; see `Fit.standard_error`."""
    layout = Layout.of(found.params)
    asked = attached(found, ASKED)
    if any(map(checks.is_traced, jax.tree.leaves(found.params))) or (found.covariance is None and asked is None):
        raise ValueError("standard_error needs the fit as `fit` gave it, with values, uninterrupted; fit again")
    direction = _of_name(layout, of) if isinstance(of, str) else _of_function(layout, found.params, of)
    if found.covariance is None:
        return float(asked.errors(direction)[0])
    error = np.asarray(layout.vector(found.stderr), float)
    if isinstance(of, str):
        return float(error[np.argmax(direction)])
    blind = np.zeros((len(error), 0)) if np.isfinite(error).all() else attached(found, BLIND)
    if blind is None:
        raise ValueError("standard_error of a function needs the fit as `fit` gave it, not a copy; fit again")
    seen = np.abs(direction @ blind) <= SEEN * (np.abs(direction) @ np.abs(blind))  # else it moves with what is not
    covariance = np.asarray(found.covariance, float)
    return float(np.sqrt(max(float(direction @ covariance @ direction), 0.0))) if seen.all() else float(np.inf)


def _of_name(layout: Layout, name: str) -> np.ndarray:
    return np.eye(1, layout.size, layout.place(name, "of", ", or a function of the params"))[0]


def _of_function(layout: Layout, params: Any, of: Any) -> np.ndarray:
    checks.function("of", of, "(params) -> number", 'write of=lambda p: p["ks"][0] / p["mass"], or the name of one')
    x = jnp.asarray(layout.vector(params))
    shape = getattr(jax.eval_shape(lambda x: of(layout.params(x)), x), "shape", None)
    if shape != ():
        raise ValueError(f"of must return one number, got {'a tree' if shape is None else f'shape {shape}'}")
    slope = np.asarray(jax.grad(lambda x: jnp.asarray(of(layout.params(x)), x.dtype))(x), float)
    if not np.isfinite(slope).all():
        raise ValueError("of must have a finite derivative at the fitted params, got one that is not finite")
    return slope
