"""A root as a primitive: its derivatives, of any order and in both modes, by the implicit function theorem.

``jax.lax.custom_root`` has the same rule, but ``lax.scan`` drops a custom rule under reverse-over-reverse
differentiation and then meets the solver's loop; the rule of a primitive stays.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.interpreters import ad, batching, mlir

from jeuler._jax.jaxpr import Primitive, evaluate

root_p = Primitive("root")
root_p.multiple_results = True


def root(
    f: Callable[[Array], Array],
    guess: Array,
    solve: Callable[[Callable, Array], tuple[Array, Any]],
    tangent_solve: Callable[[Callable, Array], Array],
    label: str = "",
) -> tuple[Array, Any]:
    """x with f(x) = 0, differentiable in whatever f closes over.

        f(x(a), a) = 0   =>   dx/da = -(df/dx)^-1 df/da

    Args:
      f: a function of one array, to one of the same shape and dtype.
      guess: where the solver starts; the root does not depend on it.
      solve: ``solve(f, guess) -> (x, info)``; it is not differentiated. info: arrays, without derivative.
      tangent_solve: ``tangent_solve(matvec, b) -> x`` with matvec(x) = b; differentiated to higher order.
      label: of the equation, for the policy of a ``jax.checkpoint`` that keeps some roots.
    Returns: the pair (x, info).
    """

    def linearize_and_solve(x, b):
        _, matvec = jax.linearize(f, x)
        return tangent_solve(matvec, b)

    def solve_flat(x):
        x, info = solve(f, x)
        leaves, trees["info"] = jax.tree.flatten(info)
        return x, *leaves

    trees: dict[str, Any] = {}
    traced = [
        jax.make_jaxpr(solve_flat)(guess),
        jax.make_jaxpr(f)(guess),
        jax.make_jaxpr(linearize_and_solve)(guess, guess),
    ]
    # what the programs close over becomes operands, so that derivatives with respect to it are seen
    consts = tuple(tuple(program.consts) for program in traced)
    extra = ((guess,), (guess,), (guess, guess))
    programs = tuple(
        jax.make_jaxpr(lambda c, x, p=p: jax.core.eval_jaxpr(p.jaxpr, c, *x))(c, x)
        for p, c, x in zip(traced, consts, extra, strict=True)
    )
    x, *info = root_p.bind(
        lax.stop_gradient(guess),
        *(c for cs in consts for c in cs),
        programs=programs,
        sizes=tuple(map(len, consts)),
        label=label,
    )
    return x, jax.tree.unflatten(trees["info"], info)


def _split(operands: Any, sizes: tuple[int, ...]) -> list[tuple]:
    """The operands of each program."""
    ends = itertools.accumulate(sizes)
    return [tuple(operands[end - size : end]) for size, end in zip(sizes, ends, strict=True)]


@root_p.def_impl
def _run(guess, *consts, programs, sizes, label):
    return evaluate(programs[0], [*_split(consts, sizes)[0], guess])


@root_p.def_abstract_eval
def _avals(guess, *consts, programs, sizes, label):
    return programs[0].out_avals


mlir.register_lowering(root_p, mlir.lower_fun(_run, multiple_results=True))


def _jvp(primals, tangents, *, programs, sizes, label):
    x, *info = root_p.bind(*primals, programs=programs, sizes=sizes, label=label)
    no_tangents = [ad.Zero(jax.typeof(i).to_tangent_aval()) for i in info]
    (_, of_f, of_tangent_solve), (_, f_dot, _) = _split(primals[1:], sizes), _split(tangents[1:], sizes)
    moving = [n for n, dot in enumerate(f_dot) if type(dot) is not ad.Zero]
    if not moving:
        return [x, *info], [ad.Zero(jax.typeof(x).to_tangent_aval()), *no_tangents]

    def residual(*values):
        operands = list(of_f)
        for n, value in zip(moving, values, strict=True):
            operands[n] = value
        return evaluate(programs[1], [*operands, x])[0]

    _, residual_dot = jax.jvp(residual, [of_f[n] for n in moving], [f_dot[n] for n in moving])
    (minus_x_dot,) = evaluate(programs[2], [*of_tangent_solve, x, residual_dot])
    return [x, *info], [-minus_x_dot, *no_tangents]


ad.primitive_jvps[root_p] = _jvp


def _batch(operands, axes, *, programs, sizes, label):
    size = next(x.shape[axis] for x, axis in zip(operands, axes, strict=True) if axis is not None)
    guess, *consts = operands
    axis = axes[0]
    guess = jnp.broadcast_to(guess, (size, *guess.shape)) if axis is None else jnp.moveaxis(guess, axis, 0)

    def batched(program, consts, axes, *x):
        function = jax.vmap(lambda *operands: evaluate(program, operands), in_axes=(*axes, *(0 for _ in x)))
        return jax.make_jaxpr(function)(*consts, *x)

    parts = zip(programs, _split(consts, sizes), _split(axes[1:], sizes), (1, 1, 2), strict=True)
    programs = tuple(batched(program, c, a, *[guess] * n) for program, c, a, n in parts)
    out = root_p.bind(guess, *consts, programs=programs, sizes=sizes, label=label)
    return out, [0] * len(out)


batching.primitive_batchers[root_p] = _batch
