"""The incidence operator B of a graph and its transpose, as linear primitives.

    (B x)_e = x_i - x_j for the edge e = (i, j),    (B^T f)_i = sum of what the edges of i give it

A force between pairs is B^T g(B x, B v). With B and B^T linear primitives, each the transpose of the other,
every derivative of it, forward, reverse, of any order, under vmap or not, is again made of B and B^T.

How they are computed is up to a layout (see `jeuler.graphs.layouts`), a static parameter of both.
Operands: an array (..., particle) or (..., *slots), then the layout's tables. Leading axes are batches.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.interpreters import ad, batching, mlir

from jeuler._jax import batch_last
from jeuler._jax.jaxpr import Primitive
from jeuler._jax.placed import typed

difference_p: Any = Primitive("difference")
accumulate_p: Any = Primitive("accumulate")


def _difference(x, *tables, layout):
    return layout._difference(x, *tables)


def _accumulate(f, *tables, layout):
    return layout._accumulate(f, *tables)


def _difference_shape(x, *tables, layout):
    return jax.core.ShapedArray((*x.shape[:-1], *layout.slot_edges[0].shape), x.dtype)


def _accumulate_shape(f, *tables, layout):
    return jax.core.ShapedArray((*f.shape[: f.ndim - layout.slot_edges[0].ndim], layout.particles), f.dtype)


def _linear(primitive: Any, transpose: Any) -> None:
    """Derivatives and batches of a map that is linear in its first operand; the others are integer tables."""

    def jvp(primals, tangents, *, layout):
        (x, *tables), (change, *_) = primals, tangents
        return primitive.bind(x, *tables, layout=layout), primitive.bind(change, *tables, layout=layout)

    def transposed(cotangent, x, *tables, layout):
        total = transpose.bind(ad.instantiate_zeros(cotangent), *tables, layout=layout)
        return [total, *[None] * len(tables)]

    def batched(operands, axes, *, layout):
        (x, *tables), (axis, *table_axes) = operands, axes
        # the tables are the same for all: a loop whose carry holds them may have made a copy for each member
        tables = [
            table if axis is None else lax.index_in_dim(table, 0, axis, keepdims=False)
            for table, axis in zip(tables, table_axes, strict=True)
        ]
        if axis is None:
            return primitive.bind(x, *tables, layout=layout), None
        return primitive.bind(jnp.moveaxis(x, axis, 0), *tables, layout=layout), 0

    ad.primitive_jvps[primitive] = jvp
    ad.primitive_transposes[primitive] = transposed
    batching.primitive_batchers[primitive] = batched


def _register(primitive: Any, transpose: Any, rule: Any, shape: Any) -> None:
    """Teach JAX the primitive: its values, its shape, its compiled form, its derivatives and batches."""
    primitive.def_impl(jax.jit(rule, static_argnames="layout"))
    primitive.def_abstract_eval(typed(rule, shape))
    mlir.register_lowering(primitive, mlir.lower_fun(rule, multiple_results=False))
    _linear(primitive, transpose)
    batch_last.written_out[primitive] = rule


_register(difference_p, accumulate_p, _difference, _difference_shape)
_register(accumulate_p, difference_p, _accumulate, _accumulate_shape)
