"""Parameters as the search sees them: one real vector between bounds, with a name for each of its numbers."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import keystr

from jeuler._core import checks
from jeuler._core.partition import Rest, is_parameter, partition

PyTree = Any


@dataclasses.dataclass(frozen=True)
class Layout:
    """How a pytree of parameters becomes a vector and back; hashable, so that programs are kept by it.

    Leaves that are not floating numbers, such as the activation function of a network, stay as they are.
    """

    rest: Rest
    shapes: tuple[tuple[int, ...] | None, ...]  # None for a leaf that is not fitted
    dtypes: tuple[Any, ...]
    kept: tuple[str, ...] = ()  # names of integers that may have been meant to be fitted

    @classmethod
    def of(cls, params: PyTree) -> Layout:
        """The layout of these parameters, or one ValueError that says which of them cannot be fitted."""
        leaves = jax.tree_util.tree_leaves_with_path(params)
        some = any(is_parameter(x) for _, x in leaves)
        fitted = []
        for path, x in leaves:
            yes = not some or is_parameter(x) or (hasattr(x, "dtype") and _in_plain_containers(path))
            if yes:
                _refuse_not_floating(path, x)
            fitted.append(yes)
        chosen = {id(x) for (_, x), yes in zip(leaves, fitted, strict=True) if yes}
        _, rest = partition(params, lambda x: id(x) in chosen)
        pairs = list(zip(leaves, fitted, strict=True))
        shapes = tuple(jnp.shape(x) if yes else None for (_, x), yes in pairs)
        dtypes = tuple(jax.dtypes.canonicalize_dtype(jnp.result_type(x)) if yes else None for (_, x), yes in pairs)
        kept = tuple(readable(path) for path, x in leaves if isinstance(x, int) and _in_plain_containers(path))
        return cls(rest, shapes, dtypes, kept)

    @property
    def structure(self) -> Any:
        return self.rest.structure

    @property
    def dtype(self) -> Any:
        """The precision of the vector: the widest of the leaves."""
        found = [dtype for dtype in self.dtypes if dtype is not None]
        return jnp.result_type(*found) if found else jnp.result_type(float)

    @property
    def size(self) -> int:
        """How many numbers are fitted."""
        return sum(math.prod(shape) for shape in self.shapes if shape is not None)

    def vector(self, params: PyTree) -> Any:
        """The parameters as one vector: of JAX where one of them is traced, of NumPy otherwise."""
        leaves = [x for x, shape in zip(jax.tree.leaves(params), self.shapes, strict=True) if shape is not None]
        xp: Any = jnp if any(map(checks.is_traced, leaves)) else np
        parts = [xp.ravel(xp.asarray(x, self.dtype)) for x in leaves]
        return xp.concatenate(parts) if parts else np.zeros(0, self.dtype)

    def params(self, x: Any) -> PyTree:
        """The parameters of a vector."""
        leaves, start = [], 0
        for shape, dtype in zip(self.shapes, self.dtypes, strict=True):
            if shape is not None:
                size = math.prod(shape)
                leaves.append(jnp.asarray(x[start : start + size].reshape(shape), dtype))
                start += size
        return self.rest.join(leaves)

    def spread(self, name: str, prefix: PyTree, default: float) -> Any:
        """A value for each number, from a tree of values whose structure begins that of the params."""
        if not isinstance(prefix, (dict, list, tuple)) or not prefix:
            values = [default if prefix is None else prefix] * len(self.shapes)
        else:
            values = self._leafwise(name, prefix, default)
        wanted = [(v, s) for v, s in zip(values, self.shapes, strict=True) if s is not None]
        xp: Any = jnp if any(checks.is_traced(v) for v, _ in wanted) else np
        try:
            parts = [xp.ravel(xp.broadcast_to(xp.asarray(v, self.dtype), shape)) for v, shape in wanted]
        except (ValueError, TypeError):
            raise ValueError(
                f"{name} must be one value or a tree that params extends, of its shapes, got {prefix!r}"
            ) from None
        return xp.concatenate(parts) if parts else np.zeros(0, self.dtype)

    def _leafwise(self, name: str, prefix: PyTree, default: float) -> list[Any]:
        """The values of a prefix tree, one a leaf; a dict may leave names out."""
        example = jax.tree.unflatten(self.structure, list(range(len(self.shapes))))
        if isinstance(prefix, dict) and isinstance(example, dict) and set(prefix) <= set(example):
            prefix = {key: prefix.get(key) for key in example}
        try:
            spread = jax.tree.map(
                lambda value, part: jax.tree.map(lambda _: default if value is None else value, part),
                prefix,
                example,
                is_leaf=lambda x: x is None,
            )
            values = jax.tree.leaves(spread)
            if len(values) != len(self.shapes):
                raise ValueError
        except (ValueError, TypeError):
            raise ValueError(
                f"{name} must be one value or a tree that params extends, got {prefix!r} for params {self.structure}"
            ) from None
        return values

    def names(self) -> tuple[str, ...]:
        """One name for each number: "ks", "ks[3]"."""
        example = jax.tree.unflatten(self.structure, list(range(len(self.shapes))))
        names = []
        for (path, _), shape in zip(jax.tree_util.tree_leaves_with_path(example), self.shapes, strict=True):
            if shape is not None:
                whole = readable(path)
                names += [whole + (f"[{', '.join(map(str, k))}]" if shape else "") for k in np.ndindex(*shape)]
        return tuple(names)

    def place(self, name: str, argument: str, otherwise: str = "") -> int:
        """Which number has a name, or one ValueError of the argument that it came in."""
        names = self.names()
        if name not in names:
            some = ", ".join(names[:8]) + ", ..." * (len(names) > 8)
            raise ValueError(f"{argument} must be one of {some}{otherwise}, got {name!r}")
        return names.index(name)


def readable(path: tuple[Any, ...]) -> str:
    """A leaf's place in words: "ks", "ks[0]" of a list, "net.weight" of a dict or class, "params[0]" without a name."""
    keys = [getattr(part, "key", None) for part in path]
    named = bool(keys) and isinstance(keys[0], str)
    words = str(keys[0]) if named else "params"
    for part, key in list(zip(path, keys, strict=True))[named:]:
        words += f".{key}" if isinstance(key, str) and key.isidentifier() else keystr((part,))
    return words


def size_of(x: Any) -> Any:
    """What numbers are worth by themselves, as a step of an optimiser; 1 where they are 0."""
    xp: Any = jnp if checks.is_traced(x) else np
    x = xp.abs(xp.asarray(x, float))
    return xp.where(x != 0, x, 1.0)


def _in_plain_containers(path: tuple[Any, ...]) -> bool:
    """Whether a leaf is in dicts, lists and tuples, where the user put it, and not part of a class."""
    return all(isinstance(key, (jax.tree_util.DictKey, jax.tree_util.SequenceKey)) for key in path)


def _refuse_not_floating(path: tuple[Any, ...], x: Any) -> None:
    where = f"params{keystr(path)}"
    try:
        dtype = jnp.result_type(x)
    except (TypeError, ValueError):
        raise ValueError(f"{where} must be an array, got {x!r}") from None
    if jnp.issubdtype(dtype, jnp.complexfloating):
        raise ValueError(f"{where} must be real, got {dtype}; fit its real and its imaginary part")
    if not jnp.issubdtype(dtype, jnp.floating):
        raise ValueError(f"{where} must be floating, got {dtype}; convert it, for example jnp.asarray(x, dtype=float)")


def checked_bounds(layout: Layout, x: Any, bounds: PyTree, positive: PyTree) -> tuple[Any, Any]:
    """Lower and upper bound of each number, checked against the start."""
    lower, upper = _sides(layout, bounds)
    is_positive = layout.spread("positive", jax.tree.map(float, positive), 0.0) > 0
    xp: Any = jnp if any(map(checks.is_traced, (lower, upper, x))) else np
    lower = xp.where(is_positive, xp.maximum(lower, 0), lower)
    if xp is jnp:
        return lower, upper
    for wrong, expected in (
        (~np.isfinite(x), "finite"),
        (np.isnan(lower) | np.isnan(upper), "between bounds that are numbers"),
        (lower > upper, "between a lower bound and an upper bound that is not below it"),
        (x < lower, "not below its lower bound"),
        (x > upper, "not above its upper bound"),
    ):
        if wrong.any():
            k = int(np.argmax(wrong))
            bound = "" if expected == "finite" else f" for bounds ({lower[k]:g}, {upper[k]:g})"
            raise ValueError(
                f"the start of {layout.names()[k]} must be {expected}, got {x[k]:g}{bound}; start it at a "
                f"guess{'' if expected == 'finite' else ' between the bounds, or change them'}"
            )
    if layout.size and (lower == upper).all():
        raise ValueError(f"bounds must leave something to fit, got lower = upper for {', '.join(layout.names()[:6])}")
    return lower, upper


def _sides(layout: Layout, bounds: PyTree) -> tuple[Any, Any]:
    """Lower and upper bound from (lower, upper) or from {name: (lower, upper)}."""
    if bounds is None:
        lower = upper = None
    elif isinstance(bounds, dict):
        for name, pair in bounds.items():
            if not isinstance(pair, (tuple, list)) or len(pair) != 2:
                raise ValueError(
                    f"bounds[{name!r}] must be a pair (lower, upper), got {pair!r}; None or inf leaves a side open"
                )
        lower, upper = ({name: pair[side] for name, pair in bounds.items()} for side in (0, 1))
        example = jax.tree.unflatten(layout.structure, list(range(len(layout.shapes))))
        known = list(example) if isinstance(example, dict) else []
        for name in bounds:
            if name not in known:
                raise ValueError(f"bounds must name parameters, {known or 'of a dict'}, got {name!r}")
    elif isinstance(bounds, (tuple, list)) and len(bounds) == 2:
        lower, upper = bounds
    else:
        raise ValueError(
            f"bounds must be a pair (lower, upper) or a dict of such pairs by parameter, got {bounds!r}; "
            f"None or inf leaves a side open"
        )
    return layout.spread("bounds", lower, -np.inf), layout.spread("bounds", upper, np.inf)
