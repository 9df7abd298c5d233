"""A function of one member of an ensemble: differentiated as that of one, compiled for all with the batch axis last.

``vmap`` puts the batch axis first. The loops of small systems are short then, and short loops do not vectorise.

    batch first  (1024, 16)  1,024 loops of 16          batch last  (16, 1024)  16 loops of 1,024

The function is one equation, `members_p`, that holds the jaxpr of one member. Batching notes the axis of each operand
and leaves the jaxpr as it is; derivatives are those of the jaxpr, again such equations; what is compiled has the batch
axis last (see `batch_last`). XLA keeps the carry of a loop in memory in the order that its body asks for, so that from
step to step nothing is transposed. 1,024 chains of 16 run 2.8 times as fast so, see docs/architecture.md.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.interpreters import ad, batching, mlir, partial_eval

from jeuler._jax import platforms
from jeuler._jax.batch_last import batch_last, fits, mostly_numbers, reached
from jeuler._jax.jaxpr import Jaxpr, evaluate, holding_programs
from jeuler._jax.placed import is_placed

MANY = 64  # members from which on the batch axis goes last,
SHORT = 48  # if no operand of one member has a longer last axis: longer loops are as fast as they are

# Operands to results. Parameters: the jaxpr of one member; ``size``, how many members have their axis in the operands,
# None for one alone; ``axes``, where in each operand, None if it is the same for all; ``batched``, which results depend
# on the member, their axis first; ``differentiated``, whether a derivative was taken of the equation, or is it.
members_p = holding_programs("members")


def recomputed(function: Callable) -> Callable:
    """function(f, *arguments), pytrees of arrays after f, of which reverse mode keeps nothing but the arguments.

    It must return a pytree of floating or complex arrays.
    """

    def call(f, *arguments):
        of_arguments = functools.partial(function, f)
        closed, form = jax.make_jaxpr(of_arguments, return_shape=True)(*arguments)
        # it prints, or talks to other members by the name of an axis; or types name a mesh, to which a batch belongs
        if closed.effects or any(map(is_placed, [*closed.consts, *closed.in_avals, *closed.out_avals])):
            return jax.checkpoint(of_arguments, prevent_cse=False)(*arguments)
        operands = [*closed.consts, *jax.tree.leaves(arguments)]
        count = len(closed.consts)
        jaxpr = jax.make_jaxpr(lambda *x: jax.core.eval_jaxpr(closed.jaxpr, x[:count], *x[count:]))(*operands)
        alone = {"size": None, "axes": (None,) * len(operands), "batched": (False,) * len(jaxpr.out_avals)}
        results = members_p.bind(*operands, jaxpr=jaxpr, differentiated=False, **alone)
        return jax.tree.unflatten(jax.tree.structure(form), results)

    return call


def _compiled(*operands, jaxpr, size, axes, batched, differentiated):
    """The results: of all members if there is a size, those ``batched`` with the batch axis first."""
    if size is None:
        return evaluate(jaxpr, operands)
    last = [x if axis is None else jnp.moveaxis(x, axis, -1) for x, axis in zip(operands, axes, strict=True)]
    results = batch_last(jaxpr.jaxpr, jaxpr.consts, last, [axis is not None for axis in axes], size)
    return [jnp.moveaxis(x, -1, 0) if b else x[..., 0] for x, b in zip(results, batched, strict=True)]


def _shapes(*operands, jaxpr, size, batched, **_):
    return [
        jax.core.ShapedArray((size, *x.shape) if b else x.shape, x.dtype)
        for x, b in zip(jaxpr.out_avals, batched, strict=True)
    ]


# Derivatives


def _jvp(primals, tangents, *, jaxpr, size, axes, batched, **_):
    results = members_p.bind(*primals, jaxpr=jaxpr, size=size, axes=axes, batched=batched, differentiated=True)
    moving = tuple(type(x) is not ad.Zero and jnp.issubdtype(x.dtype, jnp.inexact) for x in tangents)
    tangent, used = _tangent(jaxpr, moving)
    # what a loop keeps of each step for reverse mode is kept with the batch axis last, so that it is not transposed
    kept = [x if axis is None else jnp.moveaxis(x, axis, -1) for x, axis in zip(primals, axes, strict=True)]
    kept_axes = [None if axis is None else -1 for axis in axes]
    changes = members_p.bind(
        *_chosen([*kept, *_chosen(tangents, moving)], used),
        jaxpr=tangent,
        size=size,
        axes=tuple(_chosen([*kept_axes, *_chosen(axes, moving)], used)),
        batched=batched,
        differentiated=True,
    )
    return results, changes


@functools.lru_cache(maxsize=256)
def _tangent(jaxpr: Jaxpr, moving: tuple[bool, ...]) -> tuple[Jaxpr, list[bool]]:
    """(operands, tangents of the moving ones) -> tangents of the results; and which of these inputs it uses."""

    def tangent(*inputs):
        operands, changes = inputs[: len(moving)], inputs[len(moving) :]
        fixed = _chosen(operands, _others(moving))

        def of_moving(*moved):
            return evaluate(jaxpr, _merged(moving, moved, fixed))

        return jax.jvp(of_moving, tuple(_chosen(operands, moving)), tuple(changes))[1]

    return _traced(tangent, [*jaxpr.in_avals, *_chosen(jaxpr.in_avals, moving)])


def _transpose(cotangents, *operands, jaxpr, size, axes, batched, **_):
    linear = tuple(map(ad.is_undefined_primal, operands))
    given = tuple(type(x) is not ad.Zero for x in cotangents)
    transposed, used = _transposed(jaxpr, linear, given)
    inputs = [*_chosen(operands, _others(linear)), *_chosen(cotangents, given)]
    all_axes = [*_chosen(axes, _others(linear)), *(0 if b else None for b in _chosen(batched, given))]
    input_axes = tuple(_chosen(all_axes, used))
    linear_axes = _chosen(axes, linear)
    varying = reached(transposed.jaxpr, [axis is not None for axis in input_axes])
    batched = tuple(v or axis is not None for v, axis in zip(varying, linear_axes, strict=True))
    results = members_p.bind(
        *_chosen(inputs, used), jaxpr=transposed, size=size, axes=input_axes, batched=batched, differentiated=True
    )

    def of_operand(x, is_batched, axis):
        if axis is None:  # the operand is the same for all members
            return jnp.sum(x, axis=0) if is_batched else x
        return jnp.moveaxis(x, 0, axis)

    totals = map(of_operand, results, batched, linear_axes)
    return _merged(linear, totals, [None] * len(linear))


@functools.lru_cache(maxsize=256)
def _transposed(jaxpr: Jaxpr, linear: tuple[bool, ...], given: tuple[bool, ...]) -> tuple[Jaxpr, list[bool]]:
    """(operands not linear, cotangents given) -> cotangents of the linear; and which of these inputs it uses."""
    known = _chosen(jaxpr.in_avals, _others(linear))

    def transposed(*inputs):
        def of_linear(*moved):
            return _chosen(evaluate(jaxpr, _merged(linear, moved, inputs)), given)

        forms = map(_form, _chosen(jaxpr.in_avals, linear))
        return jax.linear_transpose(of_linear, *forms)(list(inputs[len(known) :]))

    return _traced(transposed, [*known, *_chosen(jaxpr.out_avals, given)])


def _traced(function: Callable, avals: Sequence) -> tuple[Jaxpr, list[bool]]:
    """The function of only those operands that it uses, and which these are."""
    closed = jax.make_jaxpr(function)(*map(_form, avals))
    everything = [True] * len(closed.jaxpr.outvars)
    jaxpr, used_consts, used = partial_eval.dce_jaxpr_consts(closed.jaxpr, everything)
    return closed.replace(jaxpr=jaxpr, consts=_chosen(closed.consts, used_consts)), used


# Batches


def _batch(axis_data, operands, new_axes, *, jaxpr, size, axes, batched, differentiated):
    """The new batch axis goes last if that is faster, and not behind a derivative taken before.

    What a loop keeps for that derivative would have the batch axis first, by JAX's rule for loops, and be transposed
    at each step. Such an axis, or a second one, goes into the jaxpr, as JAX does it.
    """
    count, new = axis_data.size, tuple(axis is not None for axis in new_axes)
    reach = reached(jaxpr.jaxpr, new)
    if size is None and not differentiated and _is_better_last(jaxpr, new, count):
        results = members_p.bind(
            *operands, jaxpr=jaxpr, size=count, axes=tuple(new_axes), batched=reach, differentiated=False
        )
        return results, [0 if r else None for r in reach]
    operands = [x if axis is None else jnp.moveaxis(x, axis, 0) for x, axis in zip(operands, new_axes, strict=True)]
    axes = tuple(axis if axis is None or axis < 0 else axis + n for axis, n in zip(axes, new, strict=True))
    results = members_p.bind(
        *operands,
        jaxpr=_batched(jaxpr, new, count),
        size=size,
        axes=axes,
        batched=batched,
        differentiated=differentiated,
    )
    return results, [int(b) if r else None for r, b in zip(reach, batched, strict=True)]


def _is_better_last(jaxpr: Jaxpr, new: Sequence[bool], count: int) -> bool:
    """Not where a member is taken apart into numbers, as Lorenz's equations: these are loops over the members as it is,
    and to move the axis costs the gradient of Lorenz's equations twice its time."""
    longest = max((aval.shape[-1] if aval.ndim else 1 for aval in _chosen(jaxpr.in_avals, new)), default=0)
    if not platforms.batch_last() or count < MANY or longest > SHORT:
        return False
    return fits(jaxpr.jaxpr, new) and not mostly_numbers(jaxpr.jaxpr, new)


@functools.lru_cache(maxsize=256)
def _batched(jaxpr: Jaxpr, new: tuple[bool, ...], count: int) -> Jaxpr:
    """The jaxpr of so many side by side, batch axis first."""
    ins, outs = ([0 if b else None for b in flags] for flags in (new, reached(jaxpr.jaxpr, new)))
    forms = [
        jax.ShapeDtypeStruct((count, *x.shape) if n else x.shape, x.dtype)
        for x, n in zip(jaxpr.in_avals, new, strict=True)
    ]
    return jax.make_jaxpr(jax.vmap(lambda *x: evaluate(jaxpr, x), ins, outs, axis_size=count))(*forms)


# Flags


def _chosen(xs: Iterable, flags: Iterable[bool]) -> list:
    return [x for x, flag in zip(xs, flags, strict=True) if flag]


def _others(flags: Iterable[bool]) -> list[bool]:
    return [not flag for flag in flags]


def _merged(flags: Iterable[bool], chosen: Iterable, others: Iterable) -> list:
    """The lists in one again: at each flag that is set the next of those chosen, else the next of the others."""
    chosen, others = iter(chosen), iter(others)
    return [next(chosen if flag else others) for flag in flags]


def _form(x: Any) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(x.shape, x.dtype)


members_p.def_impl(_compiled)
members_p.def_abstract_eval(_shapes)
mlir.register_lowering(members_p, mlir.lower_fun(_compiled, multiple_results=True))
ad.primitive_jvps[members_p] = _jvp
ad.primitive_transposes[members_p] = _transpose
batching.fancy_primitive_batchers[members_p] = _batch
