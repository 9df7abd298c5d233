"""Parameters as the optimiser sees them: one vector, logarithms where they must stay positive."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.flatten_util import ravel_pytree
from jax.tree_util import keystr

from jeuler._core import checks
from jeuler._core.partition import Rest, is_parameter, partition

PyTree = Any


@dataclasses.dataclass(frozen=True)
class Unknowns:
    """The change of variables between parameters p and the vector z.

        p = p0 exp(z) where positive,   p = p0 + scale z elsewhere

    A step of one in z is then a large but sensible step in every parameter, whatever its unit, and z = 0 is the start
    exactly.
    """

    origin: Array
    names: tuple[str, ...]
    is_log: np.ndarray
    scale: np.ndarray
    unravel: Callable[[Array], PyTree]
    kept: tuple[str, ...] = ()  # integers among the parameters, which stay as they are

    @classmethod
    def of(cls, params: PyTree, positive: PyTree, scale: PyTree = None) -> Unknowns:
        """From starting values; ``positive`` and ``scale`` are trees of the structure of params or a prefix of it."""
        whole, (leaves, rest, kept) = params, _fitted(params)
        params = [checks.state("params" + keystr(path), x) for path, x in leaves]
        names = tuple(
            keystr(path) + ("" if not x.ndim else str(list(map(int, np.unravel_index(k, x.shape)))))
            for (path, _), x in zip(leaves, params, strict=True)
            for k in range(x.size)
        )
        p, unravel_fitted = ravel_pytree(params)
        values: np.ndarray = np.asarray(p)
        is_log = np.asarray(_spread("positive", positive, whole, np.bool_))
        natural = np.where(values != 0, np.abs(values), 1.0)
        sizes = natural if scale is None else np.asarray(_spread("scale", scale, whole, values.dtype))
        wrong = np.flatnonzero(~np.isfinite(values) | (is_log & ~(values > 0)))
        if wrong.size:
            k = int(wrong[0])
            expected = "finite" if not np.isfinite(values[k]) else "greater than 0 (it is fitted as a logarithm)"
            raise ValueError(
                f"the start of params{names[k]} must be {expected}, got {values[k]}; start it at a positive guess"
            )
        return cls(p, names, is_log, sizes.astype(values.dtype), lambda z: rest.join(unravel_fitted(z)), kept)

    @property
    def start(self) -> Array:
        """Where the search begins."""
        return jnp.zeros_like(self.origin)

    def params(self, z: Array) -> PyTree:
        """The parameters at z."""
        factor = jnp.exp(jnp.where(self.is_log, z, 0))
        return self.unravel(jnp.where(self.is_log, self.origin * factor, self.origin + self.scale * z))

    def slope(self, z: Array) -> np.ndarray:
        """dp/dz, elementwise."""
        return np.where(self.is_log, self.origin * np.exp(np.where(self.is_log, np.asarray(z), 0)), self.scale)


def _fitted(params: PyTree) -> tuple[list[tuple], Rest, tuple[str, ...]]:
    """The leaves to fit with their paths, the rest, and the names of integers in it that may have been meant to fit.

    A network holds functions, names and counts beside its weights; these stay. An array of integers that is no part of
    a class is a mistake, as are integers alone: they are among those to fit, for the check to name.
    """
    leaves = jax.tree_util.tree_leaves_with_path(params)
    some = any(is_parameter(x) for _, x in leaves)
    plain = (jax.tree_util.DictKey, jax.tree_util.SequenceKey)

    def in_plain_containers(path):
        return all(isinstance(key, plain) for key in path)

    fitted = [
        (path, x)
        for path, x in leaves
        if not some or is_parameter(x) or (hasattr(x, "dtype") and in_plain_containers(path))
    ]
    chosen = {id(x) for _, x in fitted}
    _, rest = partition(params, lambda x: id(x) in chosen)
    kept = [keystr(path) for path, x in leaves if isinstance(x, int) and in_plain_containers(path)]
    return fitted, rest, tuple(kept)


def _spread(name: str, prefix: PyTree, params: PyTree, dtype: Any) -> np.ndarray:
    """A prefix tree of params, one value for each of its numbers."""
    try:
        full = jax.tree.map(lambda value, part: jax.tree.map(lambda _: value, part), prefix, params)
    except (ValueError, TypeError):
        raise ValueError(
            f"{name} must be one value or a tree that params extends, got {prefix!r} "
            f"for params {jax.tree.structure(params)}"
        ) from None
    parts = [
        np.broadcast_to(np.asarray(value, dtype), np.shape(x)).ravel()
        for value, x in zip(jax.tree.leaves(full), jax.tree.leaves(params), strict=True)
        if is_parameter(x)
    ]
    return np.concatenate(parts) if parts else np.zeros(0, dtype)
