"""The weighted Laplacian of the edges of some constant offsets and its partner, as bilinear primitives without scatter.

    products(x, y)  = (B x)(B y)        one number an edge
    laplacian(c, x) = B^T (c B x)       one number a particle

with B the signed incidence operator, (B x)_e = x_i - x_j for the edge e = (i, j). A force along the line between its
particles is laplacian(c, x), c a function of the lengths r^2 = products(x, x) and the approach products(v, x). Each
one's transposes are again the two,

    products to x:  laplacian(., y)       laplacian to c:  products(., x),  to x:  laplacian(c, .)

so that every derivative of the force, forward, reverse, of any order, under vmap or not, is made of them: none
scatters, and none stores a vector an edge.

Edges of one offset k make a group. Slot s of its array holds the edge (s - k, s):

    x padded      0 0 | x0 x1 x2 x3 | 0 0        k = 2
    minus shifted       0  0  x0 x1 x2 x3        slots 0 .. particles + k - 1; the first and last k are empty

The padding costs k empty slots at each end and frees both maps of branches, so that they vectorise: no index, no mask.
A slot takes 4 loads and 3 flops a component in products, 4 loads (2 of them c) and 6 flops in laplacian, which takes
the difference at both ends: to store it would cost more. An empty slot holds some product; its c must be 0.

Operands: arrays (..., particle), and (..., slot) a group. Leading axes are batches, the same for all.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
from jax import Array
from jax.interpreters import ad, batching, mlir

from jeuler._core.vectors import total
from jeuler._jax import batch_last
from jeuler._jax.jaxpr import Primitive
from jeuler._jax.materialise import padded, stored
from jeuler._jax.placed import typed

products_p: Any = Primitive("products")
products_p.multiple_results = True
laplacian_p: Any = Primitive("laplacian")


def products(x: Array, y: Array, offsets: tuple[int, ...]) -> list[Array]:
    """(B x)(B y): two arrays (particle,) to one (particle + k,) for each offset k."""
    return products_p.bind(x, y, offsets=offsets)


def laplacian(c: Sequence[Array], x: Array, offsets: tuple[int, ...]) -> Array:
    """B^T (c B x): c a (particle + k,) for each offset k, 0 in empty slots, and x (particle,), to (particle,)."""
    return laplacian_p.bind(*c, x, offsets=offsets)


def _products(x, y, *, offsets):
    n, reach = x.shape[-1], max(offsets)
    x, y = padded(x, reach), padded(y, reach)

    def difference(x, k):
        return x[..., reach - k : reach + n] - x[..., reach : reach + n + k]

    return [difference(x, k) * difference(y, k) for k in offsets]


def _laplacian(*operands, offsets):
    *c, x = operands
    n, reach = x.shape[-1], max(offsets)
    around = padded(x, reach)
    force = 0
    for k, weight in zip(offsets, c, strict=True):
        before, after = around[..., reach - k : reach - k + n], around[..., reach + k : reach + k + n]
        force = force + weight[..., k:] * (x - after) - weight[..., :n] * (before - x)
    return force


def _products_jvp(primals, tangents, *, offsets):
    (x, y), (dx, dy) = primals, tangents
    out = products(x, y, offsets)
    if x is y and dx is dy:
        return out, [2 * d for d in products(ad.instantiate_zeros(dx), x, offsets)]
    changes = [products(d, other, offsets) for d, other in ((dx, y), (dy, x)) if type(d) is not ad.Zero]
    return out, [total(group) for group in zip(*changes, strict=True)]


def _laplacian_jvp(primals, tangents, *, offsets):
    (*c, x), (*dc, dx) = primals, tangents
    changes = []
    if any(type(d) is not ad.Zero for d in dc):
        changes.append(laplacian(list(map(ad.instantiate_zeros, dc)), x, offsets))
    if type(dx) is not ad.Zero:
        changes.append(laplacian(c, dx, offsets))
    return laplacian(c, x, offsets), total(changes)


def _products_transpose(cotangents, x, y, *, offsets):
    c = [stored(ad.instantiate_zeros(cotangent)) for cotangent in cotangents]
    if ad.is_undefined_primal(x):
        return [laplacian(c, y, offsets), None]
    return [None, laplacian(c, x, offsets)]


def _laplacian_transpose(cotangent, *operands, offsets):
    *c, x = operands
    cotangent = ad.instantiate_zeros(cotangent)
    if ad.is_undefined_primal(x):
        return [*[None] * len(c), laplacian(c, cotangent, offsets)]
    return [*products(cotangent, x, offsets), None]


def _batched(primitive):
    def rule(operands, axes, *, offsets):
        size = next(x.shape[axis] for x, axis in zip(operands, axes, strict=True) if axis is not None)
        operands = [batching.bdim_at_front(x, axis, size) for x, axis in zip(operands, axes, strict=True)]
        out = primitive.bind(*operands, offsets=offsets)
        return (out, [0] * len(out)) if primitive.multiple_results else (out, 0)

    return rule


def _products_types(x, y, *, offsets):
    return [jax.core.ShapedArray((*x.shape[:-1], x.shape[-1] + k), x.dtype) for k in offsets]


def _laplacian_type(*operands, offsets):
    return jax.core.ShapedArray(operands[-1].shape, operands[-1].dtype)


def _register(primitive: Any, rule: Any, types: Any) -> None:
    """Teach JAX the values, types, compiled form and batches of the primitive; its derivatives follow below."""
    primitive.def_impl(jax.jit(rule, static_argnames="offsets"))
    primitive.def_abstract_eval(typed(rule, types))
    mlir.register_lowering(primitive, mlir.lower_fun(rule, multiple_results=primitive.multiple_results))
    batching.primitive_batchers[primitive] = _batched(primitive)
    batch_last.written_out[primitive] = rule


_register(products_p, _products, _products_types)
_register(laplacian_p, _laplacian, _laplacian_type)
ad.primitive_jvps[products_p] = _products_jvp
ad.primitive_jvps[laplacian_p] = _laplacian_jvp
ad.primitive_transposes[products_p] = _products_transpose
ad.primitive_transposes[laplacian_p] = _laplacian_transpose
