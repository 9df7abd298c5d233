"""Arrays on a mesh: what JAX's types say of it, for primitives and loops of our own.

The type of an array names the axes of a mesh that it is divided over, where these are explicit, and under
``jax.shard_map`` those over which it varies. A primitive that says shape and dtype alone would lose both.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
from jax import lax
from jax._src import core  # the batches around a call: no public name tells them

PyTree = Any


def type_of(x: Any) -> Any:
    """The type of an array, or the type that x is."""
    return x if isinstance(x, core.AbstractValue) else jax.typeof(x)


def bare(x: Any) -> Any:
    """The type of x without a mesh."""
    type_ = type_of(x)
    return core.ShapedArray(type_.shape, type_.dtype)


def varying_axes(x: Any) -> frozenset[str]:
    """The axes of the mesh over which x, an array or its type, differs from device to device in ``jax.shard_map``."""
    told = next(iter(told_of_axes(x).values()), None)
    return frozenset(getattr(told, "varying", told) or ())


def told_of_axes(x: Any) -> dict[str, Any]:
    """What the type of x tells of these axes, by its name there: since JAX 0.10 a record, before the set itself."""
    return {name: getattr(type_of(x), name) for name in ("manual_axis_type", "vma") if hasattr(type_of(x), name)}


def explicit_mesh(x: Any) -> Any:
    """The mesh of the type of x, an array or a type, if some of its axes are explicit; else None."""
    mesh = getattr(getattr(type_of(x), "sharding", None), "mesh", None)
    kinds = getattr(mesh, "axis_types", None) or ()
    return mesh if any(kind.name == "Explicit" for kind in kinds) else None


def is_placed(x: Any) -> bool:
    """Whether the type of x, an array or a type, names axes of a mesh."""
    return explicit_mesh(x) is not None or bool(varying_axes(x))


def may_be_placed() -> bool:
    """Whether a batch around this call is divided over explicit axes of a mesh, or this is inside ``jax.shard_map``."""
    return bool(getattr(core.get_axis_env(), "explicit_mesh_axis_names", ()) or manual_axes())


def manual_axes() -> Any:
    """The axes of the mesh whose devices run the program around this call each by itself, as in ``jax.shard_map``."""
    return getattr(jax.sharding.get_abstract_mesh(), "manual_axes", ())


def typed(rule: Callable[..., Any], types: Callable[..., Any]) -> Callable[..., Any]:
    """``types(*operands, **parameters)``, and on a mesh the types of what the rule makes of the operands."""

    def of(*operands, **parameters):
        plain = types(*operands, **parameters)
        if not any(map(is_placed, operands)):
            return plain
        found = jax.make_jaxpr(functools.partial(rule, **parameters))(*operands).out_avals
        return found if isinstance(plain, (list, tuple)) else found[0]

    return of


def as_varying(x: Any, axes: frozenset[str]) -> Any:
    """x, varying over these axes too, as far as its type goes."""
    more = tuple(sorted(axes - varying_axes(x)))
    if not more:
        return x
    if hasattr(lax, "pcast"):
        return lax.pcast(x, more, to="varying")
    return lax.pvary(x, more)  # type: ignore[attr-defined]  # what JAX 0.8 has


def as_carried(body: Callable[[PyTree], PyTree], carry: PyTree) -> PyTree:
    """The carry of a loop, each part varying over the axes of the mesh over which it does after some turns of body."""
    if not manual_axes():
        return carry
    leaves, structure = jax.tree.flatten(carry)
    while True:
        after = jax.make_jaxpr(body)(jax.tree.unflatten(structure, leaves)).out_avals
        axes = [varying_axes(x) | varying_axes(type_) for x, type_ in zip(leaves, after, strict=True)]
        if axes == list(map(varying_axes, leaves)):
            return jax.tree.unflatten(structure, leaves)
        leaves = list(map(as_varying, leaves, axes))
