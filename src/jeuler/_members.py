"""A function of one member of an ensemble: differentiated as that of one, compiled for all with the batch axis last.

Under ``vmap`` JAX puts the batch axis first. The loops of small systems then are short: an inner loop over the 16
particles of a chain does not vectorise, one over 1,024 chains does.

    members first  (1024, 16)   1,024 loops of 16          members last  (16, 1024)   16 loops of 1,024

`recomputed` binds one primitive that keeps the function of one member as a jaxpr, and which operands hold one value a
member. Its derivatives are those of the one, again such primitives; only what is compiled sees the batch. There every
operation takes its operands with the batch axis last, whatever rank they have, so that nothing but broadcasts and a few
shapes change. XLA keeps the carry of a loop in the order in memory that its body asks for, so the batch axis stays last
from step to step and moving it costs nothing.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.interpreters import ad, batching, mlir
from jax.interpreters import partial_eval as pe

PyTree = Any
Jaxpr = Any

members_p: Any = type(lax.add_p)("members")
members_p.multiple_results = True

written_out: dict[Any, Callable] = {}  # primitives that other primitives express: (*operands, **parameters) -> results


def recomputed(function: Callable) -> Callable:
    """The same function of pytrees of arrays, of which reverse mode keeps nothing but the arguments."""

    @functools.wraps(function)
    def call(*arguments):
        closed, form = jax.make_jaxpr(function, return_shape=True)(*arguments)
        if closed.jaxpr.effects:  # prints, or talks to other members by the name of an axis
            return jax.checkpoint(function, prevent_cse=False)(*arguments)
        leaves = jax.tree.leaves(arguments)
        operands = [*closed.consts, *leaves]
        count = len(closed.consts)
        jaxpr = jax.make_jaxpr(lambda *x: jax.core.eval_jaxpr(closed.jaxpr, x[:count], *x[count:]))(*operands)
        out = members_p.bind(*operands, jaxpr=jaxpr, size=None, mapped=(False,) * len(operands), out=(False,) * len(jaxpr.out_avals))
        return jax.tree.unflatten(jax.tree.structure(form), out)

    return call


def evaluate(jaxpr: Jaxpr, operands: Sequence) -> list:
    return jax.core.eval_jaxpr(jaxpr.jaxpr, jaxpr.consts, *operands)


# --- derivatives: those of one member


def _jvp(primals, tangents, *, jaxpr, mapped, **params):
    out = members_p.bind(*primals, jaxpr=jaxpr, mapped=mapped, **params)
    moving = tuple(type(t) is not ad.Zero and is_inexact(t) for t in tangents)
    tangent, used = _tangent(jaxpr, moving)
    operands = [*primals, *chosen(tangents, moving)]
    flags = (*mapped, *chosen(mapped, moving))
    smooth = [is_inexact(x) for x in out]
    params["out"] = tuple(chosen(params["out"], smooth))
    dots = iter(members_p.bind(*chosen(operands, used), jaxpr=tangent, mapped=tuple(chosen(flags, used)), **params))
    return out, [next(dots) if s else ad.Zero.from_primal_value(x) for x, s in zip(out, smooth, strict=True)]


@functools.lru_cache(maxsize=256)
def _tangent(jaxpr: Jaxpr, moving: tuple[bool, ...]) -> tuple[Jaxpr, tuple[bool, ...]]:
    """(operands, the moving ones' tangents) -> tangents of the results, and which of these operands it uses."""

    def tangent(*operands):
        primals, dots = operands[: len(moving)], operands[len(moving) :]

        def of_moving(*inner):
            inner = iter(inner)
            out = evaluate(jaxpr, [next(inner) if m else x for x, m in zip(primals, moving, strict=True)])
            return [x for x in out if is_inexact(x)]

        return jax.jvp(of_moving, tuple(chosen(primals, moving)), tuple(dots))[1]

    return trimmed(tangent, [*jaxpr.in_avals, *chosen(jaxpr.in_avals, moving)])


def _transpose(cotangents, *operands, jaxpr, size, mapped, out):
    linear = tuple(map(ad.is_undefined_primal, operands))
    given = tuple(type(c) is not ad.Zero for c in cotangents)
    transposed, used = _transposed(jaxpr, linear, given)
    known = [not x for x in linear]
    inputs = chosen([*chosen(operands, known), *chosen(cotangents, given)], used)
    flags = tuple(chosen([*chosen(mapped, known), *chosen(out, given)], used))
    varies = reached(transposed, flags)
    own = list(chosen(mapped, linear))
    out_flags = tuple(a or b for a, b in zip(varies, own, strict=True))
    totals = members_p.bind(*inputs, jaxpr=transposed, size=size, mapped=flags, out=out_flags)
    totals = iter(
        jnp.sum(x, axis=0) if summed and not each else x
        for x, summed, each in zip(totals, varies, own, strict=True)
    )
    return [next(totals) if x else None for x in linear]


@functools.lru_cache(maxsize=256)
def _transposed(jaxpr: Jaxpr, linear: tuple[bool, ...], given: tuple[bool, ...]) -> tuple[Jaxpr, tuple[bool, ...]]:
    """(operands not linear, cotangents given) -> cotangents of the linear operands, and which of these it uses."""
    known_avals = [aval for aval, x in zip(jaxpr.in_avals, linear, strict=True) if not x]
    linear_avals = chosen(jaxpr.in_avals, linear)

    def transposed(*inputs):
        known, cotangents = inputs[: len(known_avals)], inputs[len(known_avals) :]

        def of_linear(*inner):
            outer, inner = iter(known), iter(inner)
            out = evaluate(jaxpr, [next(inner if x else outer) for x in linear])
            return list(chosen(out, given))

        return jax.linear_transpose(of_linear, *map(shape_of, linear_avals))(list(cotangents))

    return trimmed(transposed, [*known_avals, *chosen(jaxpr.out_avals, given)])


def trimmed(function: Callable, avals: Sequence) -> tuple[Jaxpr, tuple[bool, ...]]:
    """The function as a jaxpr of only those operands that it uses, and which those are."""
    closed = jax.make_jaxpr(function)(*map(shape_of, avals))
    jaxpr, used_consts, used = pe.dce_jaxpr_consts(closed.jaxpr, [True] * len(closed.jaxpr.outvars))
    return closed.replace(jaxpr=jaxpr, consts=chosen(closed.consts, used_consts)), tuple(used)


def shape_of(aval):
    return jax.ShapeDtypeStruct(aval.shape, aval.dtype)


def is_inexact(x) -> bool:
    return jnp.issubdtype(x.dtype, jnp.inexact)


def chosen(xs, flags):
    return [x for x, flag in zip(xs, flags, strict=True) if flag]


# --- batches


def _batch(axis_data, operands, axes, *, jaxpr, size, mapped, out):
    new = axis_data.size
    along = tuple(a is not None for a in axes)
    if size is None and last_is_better(jaxpr, new):
        moved = [x if a is None else jnp.moveaxis(x, a, 0) for x, a in zip(operands, axes, strict=True)]
        out = reached(jaxpr, along)
        return members_p.bind(*moved, jaxpr=jaxpr, size=new, mapped=along, out=out), [0 if r else None for r in out]
    moved = [x if a is None else jnp.moveaxis(x, a, int(m)) for x, a, m in zip(operands, axes, mapped, strict=True)]
    batched, reach = _batched(jaxpr, new, along)
    results = members_p.bind(*moved, jaxpr=batched, size=size, mapped=mapped, out=out)
    return results, [int(m) if r else None for r, m in zip(reach, out, strict=True)]


@functools.lru_cache(maxsize=256)
def _batched(jaxpr, size, along):
    """The jaxpr of ``size`` members side by side, as JAX batches it."""
    reach = reached(jaxpr, along)
    axes = [0 if a else None for a in along]
    function = jax.vmap(lambda *x: evaluate(jaxpr, x), axes, [0 if r else None for r in reach], axis_size=size)
    avals = [
        jax.ShapeDtypeStruct((size, *x.shape) if a else x.shape, x.dtype) for x, a in zip(jaxpr.in_avals, along, strict=True)
    ]
    return jax.make_jaxpr(function)(*avals), reach


def reached(jaxpr: Jaxpr, flags: Sequence[bool]) -> tuple[bool, ...]:
    """Which results depend on the flagged operands."""
    found = {v for v, flag in zip(jaxpr.jaxpr.invars, flags, strict=True) if flag}

    def is_found(v):
        return not hasattr(v, "val") and v in found

    for eqn in jaxpr.jaxpr.eqns:
        if any(map(is_found, eqn.invars)):
            found.update(eqn.outvars)
    return tuple(map(is_found, jaxpr.jaxpr.outvars))


def last_is_better(jaxpr, size):
    return size >= 16 and suits(jaxpr)


@functools.lru_cache(maxsize=256)
def suits(jaxpr) -> bool:
    """Whether all operations are such as keep a last axis."""
    for eqn in jaxpr.jaxpr.eqns:
        inner = inner_jaxpr(eqn)
        if inner is not None:
            if not suits(inner):
                return False
        elif not (eqn.primitive.name in AXES_KEPT or eqn.primitive in RESHAPED or is_elementwise(eqn.primitive) or not eqn.invars):
            return False
    return True


# --- what is compiled


def _run(*operands, jaxpr, size, mapped, out):
    if size is None:
        return evaluate(jaxpr, operands)
    operands = [jnp.moveaxis(x, 0, -1) if m else x for x, m in zip(operands, mapped, strict=True)]
    results, flags = batch_last(jaxpr, operands, mapped, size)
    results = [spread(x, on, x.shape[: x.ndim - on], size) if m else x for x, on, m in zip(results, flags, out, strict=True)]
    return [jnp.moveaxis(x, -1, 0) if m else x for x, m in zip(results, out, strict=True)]


def batch_last(jaxpr, operands, flags, size):
    """The results of ``size`` members, and which of them have the batch axis, the last one."""
    values = dict(zip(jaxpr.jaxpr.invars, zip(operands, flags, strict=True), strict=True))
    values |= {v: (x, False) for v, x in zip(jaxpr.jaxpr.constvars, jaxpr.consts, strict=True)}

    def read(v):
        return (jnp.asarray(v.val, v.aval.dtype), False) if hasattr(v, "val") else values[v]

    for eqn in jaxpr.jaxpr.eqns:
        xs, on = zip(*map(read, eqn.invars), strict=True) if eqn.invars else ((), ())
        results, on_out = _apply(eqn, xs, on, size)
        values.update(zip(eqn.outvars, zip(results, on_out, strict=True), strict=True))
    results = [read(v) for v in jaxpr.jaxpr.outvars]
    return [x for x, _ in results], [on for _, on in results]


def _apply(eqn, xs, on, size):
    primitive, params, count = eqn.primitive, eqn.params, len(eqn.outvars)

    def bind(*xs):
        out = primitive.bind(*xs, **params)
        return out if primitive.multiple_results else [out]

    inner = inner_jaxpr(eqn)
    if inner is not None:
        return batch_last(inner, xs, on, size)
    if not any(on):
        return bind(*xs), [False] * count
    if primitive in RESHAPED and on[0] and not any(on[1:]):
        return [RESHAPED[primitive](*xs, size=size, **params)], [True]
    shapes = [v.aval.shape for v in eqn.invars]
    if primitive.name in AXES_KEPT:
        return bind(*(spread(x, o, shape, size) for x, o, shape in zip(xs, on, shapes, strict=True))), [True] * count
    if is_elementwise(primitive):
        shape = eqn.outvars[0].aval.shape
        return bind(*(spread(x, o, shape, size) for x, o in zip(xs, on, strict=True))), [True] * count
    return jax.vmap(bind, [-1 if o else None for o in on], -1, axis_size=size)(*xs), [True] * count


def spread(x, on: bool, shape, size: int):
    """x of each member, of this shape, with the batch axis last."""
    x = jnp.asarray(x)
    x = x if on else x[..., None]
    return jnp.broadcast_to(x, (*shape, size))


def inner_jaxpr(eqn):
    """The jaxpr that the equation stands for, if it stands for one."""
    if eqn.primitive in written_out:
        return _written_out(eqn.primitive, tuple((v.aval.shape, v.aval.dtype) for v in eqn.invars), tuple(sorted(eqn.params.items())))
    if eqn.primitive is members_p and eqn.params["size"] is not None:
        return None
    if eqn.primitive is members_p or eqn.primitive.name in ("jit", "pjit", "closed_call", "core_call", "custom_jvp_call", "custom_vjp_call", "checkpoint"):
        for name in ("jaxpr", "call_jaxpr", "fun_jaxpr"):
            if name in eqn.params:
                found = eqn.params[name]
                return found if hasattr(found, "consts") else _closed(found)
    return None


@functools.lru_cache(maxsize=256)
def _closed(jaxpr):
    return jax.make_jaxpr(lambda *x: jax.core.eval_jaxpr(jaxpr, (), *x))(*(shape_of(v.aval) for v in jaxpr.invars))


@functools.lru_cache(maxsize=256)
def _written_out(primitive, forms, params):
    function = functools.partial(written_out[primitive], **dict(params))
    return jax.make_jaxpr(function)(*(jax.ShapeDtypeStruct(*form) for form in forms))


ELEMENTWISE = set(
    "add add_any sub mul div rem max min pow integer_pow neg sign abs square sqrt rsqrt cbrt exp exp2 expm1 log log1p "
    "logistic sin cos tan asin acos atan atan2 sinh cosh tanh asinh acosh atanh erf erfc erf_inv lgamma digamma floor "
    "ceil round nextafter is_finite and or xor not eq ne lt le gt ge select_n clamp convert_element_type "
    "reduce_precision real imag complex conj copy stop_gradient shift_left shift_right_logical "
    "shift_right_arithmetic stored".split()
)
AXES_KEPT = set(
    "squeeze concatenate stack unstack split rev reduce_sum reduce_max reduce_min reduce_prod reduce_and reduce_or cumsum "
    "cumprod cummax cummin argmax argmin".split()
)


def is_elementwise(primitive):
    return primitive.name in ELEMENTWISE


def _slice(x, *, size, start_indices, limit_indices, strides):
    return lax.slice(x, (*start_indices, 0), (*limit_indices, size), None if strides is None else (*strides, 1))


RESHAPED = {
    lax.broadcast_in_dim_p: lambda x, *, size, shape, broadcast_dimensions, **_: lax.broadcast_in_dim(
        x, (*shape, size), (*broadcast_dimensions, len(shape))
    ),
    lax.reshape_p: lambda x, *, size, new_sizes, **_: lax.reshape(x, (*new_sizes, size)),
    lax.transpose_p: lambda x, *, size, permutation: lax.transpose(x, (*permutation, len(permutation))),
    lax.slice_p: _slice,
    lax.pad_p: lambda x, value, *, size, padding_config: lax.pad(x, value, (*padding_config, (0, 0, 0))),
}

members_p.def_impl(_run)
members_p.def_abstract_eval(
    lambda *operands, jaxpr, size, mapped, out: [
        jax.core.ShapedArray((size, *x.shape) if m else x.shape, x.dtype) for x, m in zip(jaxpr.out_avals, out, strict=True)
    ]
)
mlir.register_lowering(members_p, mlir.lower_fun(_run, multiple_results=True))
ad.primitive_jvps[members_p] = _jvp
ad.primitive_transposes[members_p] = _transpose
batching.fancy_primitive_batchers[members_p] = _batch
