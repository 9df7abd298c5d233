"""A residual as the search takes it: a function of a vector, with data and weights beside it."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jeuler._core import checks
from jeuler.fitting.least_squares import Evaluate, evaluations
from jeuler.fitting.unknowns import Layout

PyTree = Any


@dataclasses.dataclass(frozen=True)
class FlatResidual:
    """``residual(params)``, or ``residual(params, data)``, from vector to vector. Equal ones share their programs."""

    residual: Callable[..., Any]
    layout: Layout
    with_data: bool

    def __call__(self, x: Array, data: Any) -> Array:
        params = self.layout.params(x)
        out = self.residual(params, data) if self.with_data else self.residual(params)
        leaves = [jnp.ravel(leaf) for leaf in jax.tree.leaves(out)]
        return jnp.concatenate(leaves).astype(self.layout.dtype) if leaves else jnp.zeros(0, self.layout.dtype)


@functools.lru_cache(maxsize=32)
def kept_programs(residual: FlatResidual) -> Evaluate:
    """The compiled programs of a residual that takes its data as an argument: used again by the next fit."""
    return evaluations(residual, compiled=True)


def programs(residual: FlatResidual) -> Evaluate:
    """The compiled programs of a residual. One that closes over its data may read others next time: nothing is kept."""
    return kept_programs(residual) if residual.with_data else evaluations(residual, compiled=True)


def residual_layout(residual: Callable[..., Any], params: PyTree, data: Any, with_data: bool) -> tuple[Layout, bool]:
    """The form of what the residual returns, and whether it closes over something traced; or one ValueError."""
    checks.function(
        "residual",
        residual,
        "(params, data) -> residuals" if with_data else "(params) -> residuals",
        "with data=..., it is called as residual(params, data)",
    )
    layout = Layout.of(params)
    flat = jax.ShapeDtypeStruct((layout.size,), layout.dtype)
    if with_data:
        program, form = jax.make_jaxpr(lambda x, data: residual(layout.params(x), data), return_shape=True)(flat, data)
    else:
        program, form = jax.make_jaxpr(lambda x: residual(layout.params(x)), return_shape=True)(flat)
    leaves = jax.tree.leaves(form)
    for leaf in leaves:
        if not jnp.issubdtype(leaf.dtype, jnp.floating):
            raise ValueError(f"residual must return real floating arrays, got {leaf.dtype}; convert what it returns")
    return Layout.of(form), any(map(checks.is_traced, program.consts))


def series_of(layout: Layout) -> tuple[tuple[int, int], ...]:
    """(times, channels) of each leaf of a residual: its first axis is time."""
    shapes = [shape for shape in layout.shapes if shape is not None]
    return tuple((shape[0], math.prod(shape[1:])) if shape else (1, 1) for shape in shapes)


def residual_weights(layout: Layout, sigma: PyTree, weights: PyTree) -> Any:
    """What each residual is multiplied with: 1 / sigma, or the root of its weight; 0 leaves it out."""
    if sigma is not None and weights is not None:
        raise ValueError("sigma and weights must not both be given: sigma is an error, weights are relative; pass one")
    if sigma is None and weights is None:
        return np.ones(layout.size, layout.dtype)
    name = "weights" if sigma is None else "sigma"
    values = layout.spread(name, weights if sigma is None else sigma, 1.0)
    if not checks.is_traced(values):
        wrong = np.isnan(values) | (values < 0 if sigma is None else values <= 0)
        if wrong.any():
            expected = "0 or more (0 leaves a residual out)" if sigma is None else "greater than 0 (inf leaves one out)"
            raise ValueError(f"{name} must be {expected}, got {values[wrong][0]:g}")
        if not (values > 0).any() or (sigma is not None and np.isinf(values).all()):
            raise ValueError(f"{name} must leave at least one residual in, got none")
    xp: Any = jnp if checks.is_traced(values) else np
    return xp.sqrt(values) if sigma is None else 1 / values
