"""A jaxpr of one member of an ensemble, evaluated for all members with the batch axis last.

Axes of a member keep their numbers if the batch axis is behind them. So most operations, elementwise ones and those
along named axes, take their operands as they come; a few name shapes, which get one number more. Others have no such
form here (`fits` says which): gathers, sorts, matrix products, loops.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax

from jeuler._jax.jaxpr import Jaxpr, is_variable

written_out: dict[Any, Callable] = {}  # primitives that other operations express: (*operands, **parameters) -> results

ELEMENTWISE = frozenset([
    "abs", "acos", "acosh", "add", "add_any", "and", "asin", "asinh", "atan", "atan2", "atanh", "cbrt", "ceil",
    "clamp", "complex", "conj", "convert_element_type", "copy", "cos", "cosh", "digamma", "div", "eq", "erf",
    "erf_inv", "erfc", "exp", "exp2", "expm1", "floor", "ge", "gt", "imag", "integer_pow", "is_finite", "le",
    "lgamma", "log", "log1p", "logistic", "lt", "max", "min", "mul", "ne", "neg", "nextafter", "not", "or", "pow",
    "real", "reduce_precision", "rem", "round", "rsqrt", "select_n", "shift_left", "shift_right_arithmetic",
    "shift_right_logical", "sign", "sin", "sinh", "sqrt", "square", "sub", "tan", "tanh", "xor",
])  # fmt: skip
ALONG_AXES = frozenset([
    "argmax", "argmin", "concatenate", "cummax", "cummin", "cumprod", "cumsum", "reduce_and", "reduce_max",
    "reduce_min", "reduce_or", "reduce_prod", "reduce_sum", "rev", "split", "squeeze", "stack", "unstack",
])  # fmt: skip
OF_SHAPES: dict[str, Callable] = {
    "broadcast_in_dim": lambda x, size, shape, broadcast_dimensions, **_: lax.broadcast_in_dim(
        x, (*shape, size), (*broadcast_dimensions, len(shape))
    ),
    "pad": lambda x, value, size, padding_config: lax.pad(x, value, (*padding_config, (0, 0, 0))),
    "reshape": lambda x, size, new_sizes, **_: lax.reshape(x, (*new_sizes, size)),
    "slice": lambda x, size, start_indices, limit_indices, strides: lax.slice(
        x, (*start_indices, 0), (*limit_indices, size), strides and (*strides, 1)
    ),
    "transpose": lambda x, size, permutation: lax.transpose(x, (*permutation, len(permutation))),
}
CALLS = {
    "checkpoint": "jaxpr",
    "closed_call": "call_jaxpr",
    "core_call": "call_jaxpr",
    "custom_jvp_call": "call_jaxpr",
    "custom_vjp_call": "call_jaxpr",
    "custom_vjp_call_jaxpr": "fun_jaxpr",
    "jit": "jaxpr",
    "members": "jaxpr",
    "pjit": "jaxpr",
}


def fits(jaxpr: Jaxpr, batched: Sequence[bool]) -> bool:
    """Whether all that depends on these operands has a form with the batch axis last."""
    return _flow(jaxpr, tuple(batched))[0]


def reached(jaxpr: Jaxpr, batched: Sequence[bool]) -> tuple[bool, ...]:
    """Which results depend on these operands."""
    return _flow(jaxpr, tuple(batched))[1]


@functools.lru_cache(maxsize=256)
def _flow(jaxpr: Jaxpr, batched: tuple[bool, ...]) -> tuple[bool, tuple[bool, ...]]:
    found = {v for v, b in zip(jaxpr.invars, batched, strict=True) if b}
    all_fit = True
    for eqn in jaxpr.eqns:
        of = tuple(is_variable(v) and v in found for v in eqn.invars)
        if any(of):
            found.update(eqn.outvars)
            inner = _inner(eqn)
            all_fit &= fits(inner[0], of) if inner else _has_form(eqn, of)
    return all_fit, tuple(is_variable(v) and v in found for v in jaxpr.outvars)


def mostly_numbers(jaxpr: Jaxpr, batched: Sequence[bool]) -> bool:
    """Whether more of the arithmetic on these operands is of single numbers than of arrays."""
    return _arithmetic(jaxpr, tuple(batched)) > 0


@functools.lru_cache(maxsize=256)
def _arithmetic(jaxpr: Jaxpr, batched: tuple[bool, ...]) -> int:
    """How many more elementwise operations on these operands are of single numbers than of arrays."""
    found = {v for v, b in zip(jaxpr.invars, batched, strict=True) if b}
    more = 0
    for eqn in jaxpr.eqns:
        of = tuple(is_variable(v) and v in found for v in eqn.invars)
        if any(of):
            found.update(eqn.outvars)
            inner = _inner(eqn)
            if inner:
                more += _arithmetic(inner[0], of)
            elif eqn.primitive.name in ELEMENTWISE:
                more += 1 if math.prod(eqn.outvars[0].aval.shape) == 1 else -1
    return more


def _has_form(eqn: Any, batched: Sequence[bool]) -> bool:
    name = eqn.primitive.name
    return name in ELEMENTWISE or name in ALONG_AXES or (name in OF_SHAPES and not any(batched[1:]))


def batch_last(jaxpr: Jaxpr, consts: Sequence, operands: Sequence, batched: Sequence[bool], size: int) -> list[Array]:
    """The results of ``size`` members, all with the batch axis last, from operands of which some have it."""
    results, flags = _evaluate(jaxpr, consts, operands, batched, size)
    shapes = [v.aval.shape for v in jaxpr.outvars]
    return [_spread(x, b, shape, size) for x, b, shape in zip(results, flags, shapes, strict=True)]


def _evaluate(jaxpr, consts, operands, batched, size) -> tuple[list, list[bool]]:
    values = {v: (x, False) for v, x in zip(jaxpr.constvars, consts, strict=True)}
    values |= {v: (x, b) for v, x, b in zip(jaxpr.invars, operands, batched, strict=True)}

    def read(variables):
        pairs = [values[v] if is_variable(v) else (jnp.asarray(v.val, v.aval.dtype), False) for v in variables]
        return [x for x, _ in pairs], [b for _, b in pairs]

    for eqn in jaxpr.eqns:
        results, flags = _apply(eqn, size, *read(eqn.invars))
        values.update(zip(eqn.outvars, zip(results, flags, strict=True), strict=True))
    return read(jaxpr.outvars)


def _apply(eqn, size, operands, batched) -> tuple[list, list[bool]]:
    def bind(*operands):
        out = eqn.primitive.bind(*operands, **eqn.params)
        return out if eqn.primitive.multiple_results else [out]

    name, count = eqn.primitive.name, len(eqn.outvars)
    inner = _inner(eqn)
    if inner:
        return _evaluate(*inner, operands, batched, size)
    if not any(batched):
        return bind(*operands), [False] * count
    if not _has_form(eqn, batched):
        return jax.vmap(bind, [-1 if b else None for b in batched], -1, axis_size=size)(*operands), [True] * count
    if name in OF_SHAPES:
        return [OF_SHAPES[name](*operands, size=size, **eqn.params)], [True]
    of = eqn.outvars * len(operands) if name in ELEMENTWISE else eqn.invars
    shapes = [v.aval.shape for v in of]
    return bind(*(_spread(x, b, s, size) for x, b, s in zip(operands, batched, shapes, strict=True))), [True] * count


def _spread(x: Any, batched: bool, shape: tuple[int, ...], size: int) -> Array:
    """x for all members, of this shape in each, with the batch axis last."""
    return jnp.broadcast_to(x if batched else jnp.asarray(x)[..., None], (*shape, size))


def _inner(eqn: Any) -> tuple[Jaxpr, Sequence] | None:
    """The jaxpr that an equation stands for, with its constants, if it stands for one."""
    primitive = eqn.primitive
    if primitive in written_out:
        forms = tuple((v.aval.shape, v.aval.dtype) for v in eqn.invars)
        closed = _written(primitive, forms, tuple(eqn.params.items()))
    elif primitive.name in CALLS and eqn.params.get("size") is None:
        closed = eqn.params[CALLS[primitive.name]]
    else:
        return None
    return (closed.jaxpr, closed.consts) if hasattr(closed, "consts") else (closed, ())


@functools.lru_cache(maxsize=256)
def _written(primitive: Any, forms: tuple, params: tuple) -> Jaxpr:
    function = functools.partial(written_out[primitive], **dict(params))
    return jax.make_jaxpr(function)(*(jax.ShapeDtypeStruct(*form) for form in forms))
