"""The incidence operator B of a graph and its transpose, as linear primitives without scatter.

    (B x)_e = x_i - x_j for the edge e = (i, j),    (B^T f)_i = sum of what the edges of i give it

A force between pairs is B^T g(B x, B v). With B and B^T linear primitives, each the transpose of the other,
every derivative of it, forward, reverse, of any order, under vmap or not, is again made of B and B^T: none
scatters.

How they are computed is the matter of a layout (see `jeuler.forces.layouts`), a static parameter of both.
Operands: an array (..., particle), or one array (..., *slots) a group of slots, then the layout's tables.
Leading axes are batches.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.interpreters import ad, batching, mlir

from jeuler.forces.hints import Primitive

difference_p = Primitive("difference")
difference_p.multiple_results = True
accumulate_p = Primitive("accumulate")


def _difference(x, *tables, layout):
    return layout._difference(x, *tables)


def _accumulate(*operands, layout):
    groups = len(layout.slot_edges)
    return layout._accumulate(operands[:groups], *operands[groups:])


def _difference_shape(x, *tables, layout):
    return [jax.core.ShapedArray((*x.shape[:-1], *slots.shape), x.dtype) for slots in layout.slot_edges]


def _accumulate_shape(f, *rest, layout):
    batch = f.shape[: f.ndim - layout.slot_edges[0].ndim]
    return jax.core.ShapedArray((*batch, layout.particles), f.dtype)


def _difference_jvp(primals, tangents, *, layout):
    return difference_p.bind(*primals, layout=layout), difference_p.bind(tangents[0], *primals[1:], layout=layout)


def _accumulate_jvp(primals, tangents, *, layout):
    groups = len(layout.slot_edges)
    slots = map(ad.instantiate_zeros, tangents[:groups])
    tangent = accumulate_p.bind(*slots, *primals[groups:], layout=layout)
    return accumulate_p.bind(*primals, layout=layout), tangent


def _difference_transpose(cotangents, x, *tables, layout):
    slots = map(ad.instantiate_zeros, cotangents)
    return [accumulate_p.bind(*slots, *tables, layout=layout), *[None] * len(tables)]


def _accumulate_transpose(cotangent, *operands, layout):
    tables = operands[len(layout.slot_edges) :]
    slots = difference_p.bind(ad.instantiate_zeros(cotangent), *tables, layout=layout)
    return [*slots, *[None] * len(tables)]


def _batch_first(x: Any, axis: Any, size: int) -> Any:
    return batching.bdim_at_front(x, axis, size)


def _of_one_member(tables: Any, axes: Any) -> list[Any]:
    """The tables, which are the same for all: a loop whose carry holds them may have made a copy for each member."""
    return [
        x if axis is None else lax.index_in_dim(x, 0, axis, keepdims=False)
        for x, axis in zip(tables, axes, strict=True)
    ]


def _difference_batch(operands, axes, *, layout):
    x, *tables = operands
    tables = _of_one_member(tables, axes[1:])
    if axes[0] is None:
        out = difference_p.bind(x, *tables, layout=layout)
        return out, [None] * len(out)
    out = difference_p.bind(jnp.moveaxis(x, axes[0], 0), *tables, layout=layout)
    return out, [0] * len(out)


def _accumulate_batch(operands, axes, *, layout):
    groups = len(layout.slot_edges)
    tables = _of_one_member(operands[groups:], axes[groups:])
    sizes = [x.shape[axis] for x, axis in zip(operands[:groups], axes[:groups], strict=True) if axis is not None]
    if not sizes:
        return accumulate_p.bind(*operands[:groups], *tables, layout=layout), None
    slots = [_batch_first(x, axis, sizes[0]) for x, axis in zip(operands[:groups], axes[:groups], strict=True)]
    return accumulate_p.bind(*slots, *tables, layout=layout), 0


for primitive, rule, shape in (
    (difference_p, _difference, _difference_shape),
    (accumulate_p, _accumulate, _accumulate_shape),
):
    primitive.def_impl(jax.jit(rule, static_argnames="layout"))
    primitive.def_abstract_eval(shape)
    mlir.register_lowering(primitive, mlir.lower_fun(rule, multiple_results=primitive.multiple_results))

ad.primitive_jvps[difference_p] = _difference_jvp
ad.primitive_jvps[accumulate_p] = _accumulate_jvp
ad.primitive_transposes[difference_p] = _difference_transpose
ad.primitive_transposes[accumulate_p] = _accumulate_transpose
batching.primitive_batchers[difference_p] = _difference_batch
batching.primitive_batchers[accumulate_p] = _accumulate_batch
