"""Symplectic Euler that can be undone to the bit: reverse mode keeps no state between two saved ones.

    v' = v + [dt a(t, x)],   x' = x + [dt v']         [.]: the nearest multiple of a quantum, a power of two
    x  = x' - [dt v'],       v  = v' - [dt a(t, x)]   the same numbers, taken away again

Sums of multiples of one quantum are exact in floating point while they fit the mantissa, so the second line undoes the
first. Undone without the quantum, roundoff grows with the motion: the gradient of a net of 8 x 8 particles over 10,000
steps was all noise in float32.

Source: D. Levesque, L. Verlet, Molecular dynamics and time reversibility, J. Stat. Phys. 72, 1993, which does it with
integers.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax

from jeuler._core import checks, trees
from jeuler.steps.explicit import VectorField, pair, symplectic_euler_step

PyTree = Any
HEADROOM = 2  # bits: numbers may grow to four times the largest of the plain run


def check(f: VectorField, t: Any, y: PyTree, args: PyTree, step: Any, compensated: bool) -> None:
    """One ValueError if a run cannot be undone: another step, complex numbers, an acceleration that depends on v."""
    what = 'checkpoint="reversible"'
    if step is not symplectic_euler_step or compensated:
        name = "compensated sums" if compensated else getattr(step, "__name__", repr(step))
        raise ValueError(f'{what} needs symplectic_euler_step in plain sums, got {name}; or pass checkpoint="sqrt"')
    for leaf in jax.tree.leaves(y):
        if jnp.issubdtype(leaf.dtype, jnp.complexfloating):
            raise ValueError(f'{what} needs a real state, got {leaf.dtype}; pass checkpoint="sqrt"')
    (x, v), unflatten = pair(y)
    if any(map(checks.is_traced, jax.tree.leaves((t, y, args)))):
        return  # values cannot be looked at; if the acceleration does depend on v, the gradient comes out as NaN
    at = jax.tree.map(lambda leaf: leaf + 1, v)
    change = jax.jvp(lambda v: pair(f(t, unflatten((x, v)), args))[0][1], (at,), (at,))[1]
    if any(not checks.is_traced(leaf) and jnp.any(leaf != 0) for leaf in jax.tree.leaves(change)):
        raise ValueError(
            f"{what} needs an acceleration that does not depend on the velocity (kd=0, no drag), got one that does; "
            f'pass checkpoint="sqrt"'
        )


def reversible(f: VectorField, y0: PyTree, args: PyTree, grid: Any) -> tuple[PyTree, Callable[..., Any]]:
    """The start on its grid of quanta, and ``between_saves(n, first_nonfinite, y)``, the steps to the next saved state.

    A plain run, before all else, finds the largest number of each array, which sets its quantum. Both rounding and that
    run count as constant: the derivative is that of the step without rounding.
    """
    f_closed, hoisted = jax.closure_convert(f, grid.t0, y0, args)
    _, unflatten = pair(y0)
    parameters, rebuild = _floating((grid.dt, grid.t0, args, hoisted))

    def acceleration(n: Array, x: PyTree, v: PyTree, parameters: list[Array]) -> PyTree:
        dt, t0, args, hoisted = rebuild(parameters)
        t = t0 + n.astype(dt.dtype) * dt
        return pair(f_closed(t, unflatten((x, v)), args, *hoisted))[0][1]

    def field(n: Array, y: PyTree, parameters: list[Array]) -> PyTree:
        x, v = y
        return v, acceleration(n, x, v, parameters)

    largest = _largest(field, *lax.stop_gradient((pair(y0)[0], parameters)), grid.num_steps)
    quanta = jax.tree.map(quantum, largest)
    start = jax.tree.map(_on_grid, pair(y0)[0], quanta)
    steps = _Steps(acceleration, grid.save_every)
    run = jax.custom_vjp(steps.forward)
    run.defvjp(steps.kept, steps.backward)

    def between_saves(n: Array, first_nonfinite: Array, y: PyTree) -> tuple[Array, PyTree]:
        first_nonfinite, y = run(n, first_nonfinite, pair(y)[0], parameters, quanta)
        return first_nonfinite, unflatten(y)

    return unflatten(start), between_saves


@dataclasses.dataclass(frozen=True)
class _Steps:
    """The steps from one saved state to the next, forward and back; parameters[0] is dt."""

    acceleration: Callable[..., Any]
    count: int

    def kick(self, n: Array, x: PyTree, v: PyTree, parameters: list[Array], quanta: PyTree) -> PyTree:
        """[dt a(t, x)], compiled alike wherever it stands: the compiler cannot merge a branch with what is around it,
        nor know that it is always taken. Merged, it differs in the last bit, forward from backward."""

        def taken(x, v, parameters, quanta):
            return rounded(trees.scale(parameters[0], self.acceleration(n, x, v, parameters)), quanta[1])

        return lax.cond(n >= 0, taken, lambda x, v, *_: v, x, v, parameters, quanta)

    def drift(self, v: PyTree, parameters: list[Array], quanta: PyTree) -> PyTree:
        """[dt v]"""
        return rounded(trees.scale(parameters[0], v), quanta[0])

    def forward(self, n, first_nonfinite, y, parameters, quanta):
        """The state after the steps, and which of them was the first that is not finite."""

        def one_step(carry, _):
            n, first_nonfinite, (x, v) = carry
            v = trees.add(v, self.kick(n, x, v, parameters, quanta))
            x = trees.add(x, self.drift(v, parameters, quanta))
            n = n + 1
            newly_nonfinite = (first_nonfinite < 0) & ~trees.all_finite((x, v))
            return (n, jnp.where(newly_nonfinite, n, first_nonfinite), (x, v)), None

        (_, first_nonfinite, y), _ = lax.scan(one_step, (n, first_nonfinite, y), None, length=self.count)
        return first_nonfinite, y

    def kept(self, n, first_nonfinite, y, parameters, quanta):
        """What forward gives, and what the way back needs: the end, and a number by which it knows the start."""
        out = self.forward(n, first_nonfinite, y, parameters, quanta)
        return out, (n, fingerprint(y), out[1], parameters, quanta)

    def backward(self, residuals, cotangents):
        """The steps undone, and their derivative; NaN where the way back does not lead to the start."""
        n, start, end, parameters, quanta = residuals
        dt = parameters[0]

        def one_step_back(carry, _):
            n, (x, v), (x_bar, v_bar), bars = carry
            n = n - 1
            x = trees.subtract(x, self.drift(v, parameters, quanta))
            a, pull_back = jax.vjp(lambda x, p: self.acceleration(n, x, v, p), x, parameters)
            v_bar = trees.add(v_bar, trees.scale(dt, x_bar))
            dt_bar = (_dot(x_bar, v) + _dot(v_bar, a)).astype(dt.dtype)
            by_x, by_parameters = pull_back(trees.scale(dt, v_bar))
            bars = trees.add(bars, [by_parameters[0] + dt_bar, *by_parameters[1:]])
            v = trees.subtract(v, self.kick(n, x, v, parameters, quanta))
            return (n, (x, v), (trees.add(x_bar, by_x), v_bar), bars), None

        nothing = [jnp.zeros_like(p) for p in parameters]
        carry = (n + self.count, end, cotangents[1], nothing)
        (_, found, y_bar, bars), _ = lax.scan(one_step_back, carry, None, length=self.count)
        undone = fingerprint(found) == start
        y_bar, bars = jax.tree.map(lambda x: jnp.where(undone, x, jnp.nan), (y_bar, bars))
        return None, None, y_bar, bars, None


def quantum(largest: Array) -> Array:
    """The least power of two whose multiples are exact up to 2^HEADROOM times the largest."""
    _, exponent = jnp.frexp(largest)
    return jnp.ldexp(jnp.ones_like(largest), exponent + HEADROOM - jnp.finfo(largest.dtype).nmant - 1)


def rounded(x: PyTree, quanta: PyTree) -> PyTree:
    """x to the nearest multiples of the quanta, leaf by leaf."""
    return jax.tree.map(lambda leaf, q: q * jnp.round(leaf / q), x, quanta)


def fingerprint(y: PyTree) -> Array:
    """A number that changes if a bit of y does, but for rare accidents."""
    total = jnp.uint32(0)
    for leaf in jax.tree.leaves(y):
        unsigned = jnp.where(leaf == 0, 0, leaf)  # -0 comes back as 0
        bits = lax.bitcast_convert_type(unsigned, jnp.uint32).ravel()
        total = 31 * total + jnp.sum(bits * (2 * jnp.arange(bits.size, dtype=jnp.uint32) + 1), dtype=jnp.uint32)
    return total


@jax.custom_jvp
def _on_grid(x: Array, q: Array) -> Array:
    return rounded(x, q)


@_on_grid.defjvp
def _on_grid_jvp(primals, tangents):
    return _on_grid(*primals), tangents[0]


def _largest(field: Callable[..., Any], y: PyTree, parameters: list[Array], num_steps: int) -> PyTree:
    """The largest magnitude in each array of y over a plain run, whose clock is the number of the step."""

    def magnitude(y):
        return jax.tree.map(lambda leaf: jnp.max(jnp.abs(leaf), initial=0), y)

    def one_step(carry, n):
        y, largest = carry
        y = symplectic_euler_step(field, n, y, parameters[0], parameters)
        return (y, jax.tree.map(jnp.maximum, largest, magnitude(y))), None

    return lax.scan(one_step, (y, magnitude(y)), jnp.arange(num_steps, dtype=jnp.int32))[0][1]


def _floating(tree: PyTree) -> tuple[list[Array], Callable[[list[Array]], PyTree]]:
    """The floating leaves of a tree, and the function that puts such leaves back beside the others."""
    leaves, structure = jax.tree.flatten(tree)
    floating = [jnp.issubdtype(jnp.result_type(leaf), jnp.inexact) for leaf in leaves]

    def rebuild(values):
        given = iter(values)
        merged = [next(given) if is_floating else leaf for leaf, is_floating in zip(leaves, floating, strict=True)]
        return jax.tree.unflatten(structure, merged)

    chosen = [jnp.asarray(leaf) for leaf, is_floating in zip(leaves, floating, strict=True) if is_floating]
    return chosen, rebuild


def _dot(x: PyTree, y: PyTree) -> Array:
    return sum(jnp.sum(a * b) for a, b in zip(jax.tree.leaves(x), jax.tree.leaves(y), strict=True))  # type: ignore
