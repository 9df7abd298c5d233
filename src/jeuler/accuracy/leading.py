"""The leading term of a step's error as an equation, for targets whose order no pilot run is fine enough to follow."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from jeuler._core.component import Function
from jeuler._core.precision import cast, flat
from jeuler._jax import programs
from jeuler.solving._adaptive import solve_adaptive
from jeuler.steps.explicit import Step, VectorField

PyTree = Any
RTOL = 1e-10
LARGEST_ORDER = 2  # of a step: each order is one more derivative of f and of the step


def _over_time(g: Callable[..., PyTree], f: Callable[..., PyTree]) -> Callable[..., PyTree]:
    """The derivative of g(t, y) along y' = f(t, y)."""
    return lambda t, y: jax.jvp(g, (t, y), (jnp.ones_like(t), f(t, y)))[1]


def _over_step(g: Callable[..., PyTree]) -> Callable[..., PyTree]:
    return lambda h: jax.jvp(g, (h,), (jnp.ones_like(h),))[1]


def modified_field(f: VectorField, step: Step, order: int) -> VectorField:
    """What a step of order p follows but for terms of order p + 1: ``(t, y, (dt, args))``, a field without jumps.

        y' = f(t, y) + dt^p [d^(p+1)/dh^(p+1) step(h) - d^p/dt^p f] / (p + 1)!,  at h = 0, d/dt along y' = f(t, y)

    Source: E. Hairer, C. Lubich, G. Wanner, Geometric Numerical Integration, 2006, sect. IX.1.
    """

    def modified(t, y, dt_and_args):
        dt, args = dt_and_args
        t = jnp.asarray(t, dt.dtype)
        field = rate = lambda t, y: f(t, y, args)
        stepped = lambda h: step(f, t, y, h, args)  # noqa: E731
        for _ in range(order):
            rate, stepped = _over_time(rate, field), _over_step(stepped)
        part = dt**order / math.factorial(order + 1)
        both = _over_step(stepped)(jnp.zeros_like(dt)), rate(t, y)
        return jax.tree.map(lambda f, made, right: f + part * (made - right), field(t, y), *both)

    return modified


class LeadingError:
    """End states of the modified equation at any dt, by `solve_adaptive`; dt = 0 is the equation itself."""

    program: Callable[..., Any]

    def __init__(
        self, f: VectorField, y0: PyTree, t0: float, t1: float, args: PyTree, step: Step, adaptive: Step | None
    ) -> None:
        """adaptive: the step of `solve_adaptive`, None for an explicit one. To be called in double precision."""
        inputs = Function(f), Function(step), cast(y0, float), cast(args, float)
        times = jnp.asarray(t0, float), jnp.asarray(t1, float)
        order = int(getattr(step, "order", 1))
        self.program = lambda dt: programs.call(_end, (*inputs, *times, jnp.asarray(dt, float)), (order, adaptive))

    def __call__(self, dt: float) -> Any:
        """The numbers of the state at t1; NaN where the run did not get there."""
        return flat(self.program(dt))


def _end(f, step, y0, args, t0, t1, dt, order, adaptive):
    run = solve_adaptive(
        modified_field(f, step, order),
        y0,
        t0=t0,
        t1=t1,
        args=(dt, args),
        step=adaptive,
        rtol=RTOL,
        atol=1e-3 * RTOL,
        max_steps=65_536 if adaptive is None else 8_192,
    )
    return jax.tree.map(lambda leaf: leaf[-1], run.y)
