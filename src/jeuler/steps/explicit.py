"""Explicit steps. A step advances a pytree y from t to t + dt: ``(f, t, y, dt, args) -> y``."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp

from jeuler._core import checks, trees
from jeuler._core.arguments import says_what_to_write
from jeuler._jax.materialise import stored

PyTree = Any
VectorField = Callable[[Any, PyTree, Any], PyTree]  # f(t, y, args) -> dy


class Step(Protocol):
    """What ``solve`` calls: ``step(f, t, y, dt, args) -> y``."""

    def __call__(self, f: VectorField, t: Any, y: PyTree, dt: Any, args: Any) -> PyTree: ...


def explicit(order: int) -> Callable[[Callable[..., PyTree]], Any]:
    """Make a step ``y + increment`` from a function that returns the increment.

    The step keeps the increment as ``step.increment``, so that ``solve(compensated=True)`` can add it without
    losing its low bits, the order of its cumulative error as ``step.order``, and ``step.explicit``, True.
    """

    def decorate(increment: Callable[..., PyTree]) -> Any:
        @functools.wraps(increment)
        def step(f: VectorField, t: Any, y: PyTree, dt: Any, args: Any) -> PyTree:
            return trees.add(y, increment(f, t, y, dt, args))

        step.increment = increment  # type: ignore[attr-defined]
        step.order = order  # type: ignore[attr-defined]
        step.explicit = True  # type: ignore[attr-defined]
        return step

    return decorate


def is_explicit_of_first_order(step: Any) -> bool:
    """Whether a step says of itself that it is explicit and of order 1: v + dt a(v), so that long ones overshoot.

    A step of the user's own does so with the attributes ``step.explicit = True`` and ``step.order = 1``.
    """
    return getattr(step, "explicit", False) is True and getattr(step, "order", None) == 1


@explicit(order=1)
def euler_step(f: VectorField, t: Any, y: PyTree, dt: Any, args: Any) -> PyTree:
    """One explicit (forward) Euler step.

        y(t + dt) = y + dt f(t, y, args)

    For particles, y = (position, velocity): the position moves with the OLD velocity. An undamped oscillator grows
    under this step at any dt; `symplectic_euler_step` does not.

    Args:
      f: vector field, ``f(t, y, args) -> dy/dt``, of the structure of y.
      t: time, scalar, s.
      y: state, any pytree of floating or complex arrays.
      dt: step size, scalar, s.
      args: passed to f; any pytree.
    Returns: the state at t + dt, of the structure, shapes and dtypes of y. Its cumulative error is O(dt).
    Example:
      >>> import jeuler
      >>> round(float(jeuler.euler_step(lambda x, y, args: x + y / 5, 0.0, -3.0, 1.0, None)), 4)
      -3.6

    Source: L. Euler, Institutionum calculi integralis I, 1768, sect. 650.
    """
    return trees.scale(dt, f(t, y, args))


@explicit(order=1)
def symplectic_euler_step(f: VectorField, t: Any, y: PyTree, dt: Any, args: Any) -> PyTree:
    """One semi-implicit (symplectic) Euler step on y = (position, velocity).

        v(t + dt) = v + dt a(t, x, v)
        x(t + dt) = x + dt v(t + dt)

    The position moves with the NEW velocity. Stable for dt < 2/omega on an undamped oscillator, with bounded energy
    error.

    Args:
      f: vector field, ``f(t, (position, velocity), args) -> (velocity, acceleration)``.
      t: time, scalar, s.
      y: the pair (position, velocity), each a pytree of one structure, m and m/s.
      dt: step size, scalar, s.
      args: passed to f; any pytree.
    Returns: the pair (position, velocity) at t + dt. Its cumulative error is O(dt).
    Raises: ValueError, at trace time, if y is not a pair.
    Example:
      >>> import jeuler
      >>> x, v = jeuler.symplectic_euler_step(lambda t, y, args: (y[1], -y[0]), 0.0, (1.0, 0.0), 0.5, None)
      >>> float(x), float(v)
      (0.75, -0.5)

    Source: E. Hairer, C. Lubich, G. Wanner, Geometric Numerical Integration, 2006, eq. I.1.9.
    """
    (_, velocity), unflatten = pair(y)
    (_, acceleration), _ = pair(f(t, y, args))
    velocity_increment = trees.scale(dt, acceleration)
    position_increment = trees.scale(dt, trees.add(velocity, velocity_increment))
    return unflatten((position_increment, velocity_increment))


def pair(y: PyTree) -> tuple[tuple[PyTree, ...], Callable[[Any], PyTree]]:
    """The two parts of a state (position, velocity), and the function that joins two such parts again."""
    parts, structure = trees.parts(y)
    if len(parts) != 2:
        raise ValueError(
            f"y must be the pair (position, velocity) for symplectic_euler_step, got {structure}; "
            f"write the system as a pair, or use euler_step"
        )
    return tuple(parts), functools.partial(jax.tree.unflatten, structure)


class Tableau(NamedTuple):
    """An explicit Runge-Kutta method as Butcher wrote it.

    c1 |
    c2 | a21
    c3 | a31 a32
    ---+------------
       | b1  b2  b3
    """

    nodes: tuple[float, ...]
    matrix: tuple[tuple[float, ...], ...]
    weights: tuple[float, ...]


# 0 |
# 1 | 1
# --+--------
#   | 1/2 1/2
HEUN = Tableau(nodes=(0.0, 1.0), matrix=((), (1.0,)), weights=(0.5, 0.5))

#  0  |
# 1/2 | 1/2
# 1/2 |  0  1/2
#  1  |  0   0   1
# ----+----------------
#     | 1/6 1/3 1/3 1/6
RK4 = Tableau(
    nodes=(0.0, 0.5, 0.5, 1.0),
    matrix=((), (0.5,), (0.0, 0.5), (0.0, 0.0, 1.0)),
    weights=(1 / 6, 1 / 3, 1 / 3, 1 / 6),
)


def runge_kutta_increment(tableau: Tableau, f: VectorField, t: Any, y: PyTree, dt: Any, args: Any) -> PyTree:
    """dt sum_i b_i k_i with k_i = f(t + c_i dt, y + dt sum_j a_ij k_j, args)."""
    slopes: list[PyTree] = []
    for node, row in zip(tableau.nodes, tableau.matrix, strict=True):
        stage = stored_stage(trees.add(y, trees.scale(dt, trees.combine(row, slopes)))) if any(row) else y
        slopes.append(f(t + node * dt, stage, args))
    return trees.scale(dt, trees.combine(tableau.weights, slopes))


def stored_stage(stage: PyTree) -> PyTree:
    """The state of a stage, and its cotangent, each computed once.

    A field that takes a state apart, y[0], y[1], ..., has its cotangent as a sum of padded parts. Without this, XLA on
    CPU computes each part anew from all parts of the stage after it, and a turn of the loop is no longer one kernel:
    the gradient of a run of Lorenz's equations took 50 times longer.
    """

    def leaf(x: Any) -> Any:
        return stored(x) if jnp.issubdtype(jnp.result_type(x), jnp.floating) else x

    return jax.tree.map(leaf, stage)


@explicit(order=2)
def heun_step(f: VectorField, t: Any, y: PyTree, dt: Any, args: Any) -> PyTree:
    """One step of Heun's method: the mean of the slopes at both ends of an Euler step.

        k1 = f(t, y),  k2 = f(t + dt, y + dt k1),  y(t + dt) = y + dt (k1 + k2) / 2

    Args:
      f: vector field, ``f(t, y, args) -> dy/dt``.
      t: time, scalar, s.
      y: state, any pytree of floating or complex arrays.
      dt: step size, scalar, s.
      args: passed to f; any pytree.
    Returns: the state at t + dt. Two evaluations of f; cumulative error O(dt^2).
    Example:
      >>> import jeuler
      >>> float(jeuler.heun_step(lambda t, y, args: y, 0.0, 1.0, 1.0, None))
      2.5

    Source: K. Heun, Neue Methoden zur approximativen Integration, Z. Math. Phys. 45, 1900.
    """
    return runge_kutta_increment(HEUN, f, t, y, dt, args)


@explicit(order=4)
def rk4_step(f: VectorField, t: Any, y: PyTree, dt: Any, args: Any) -> PyTree:
    """One step of the classical fourth-order Runge-Kutta method.

        y(t + dt) = y + dt (k1 + 2 k2 + 2 k3 + k4) / 6

    Args:
      f: vector field, ``f(t, y, args) -> dy/dt``.
      t: time, scalar, s.
      y: state, any pytree of floating or complex arrays.
      dt: step size, scalar, s.
      args: passed to f; any pytree.
    Returns: the state at t + dt. Four evaluations of f; cumulative error O(dt^4).
    Example:
      >>> import jeuler
      >>> round(float(jeuler.rk4_step(lambda t, y, args: y, 0.0, 1.0, 1.0, None)), 4)
      2.7083

    Source: W. Kutta, Beitrag zur naeherungsweisen Integration totaler Differentialgleichungen, 1901.
    """
    return runge_kutta_increment(RK4, f, t, y, dt, args)


@says_what_to_write()
def cap_cotangent(step: Step, max_norm: float) -> CappedStep:
    """Make a step whose state passes back a cotangent of bounded norm: for long chaotic horizons.

        forward: the step as it is      reverse: c -> c min(1, max_norm / |c|),   |c|^2 summed over the whole state

    The gradient of a run over many Lyapunov times is huge and says nothing about the loss on any useful scale; with
    the cap it stays finite and leans on the last steps. It is then no longer the gradient of the loss. Under ``vmap``
    each member has its own norm. Reverse mode only.

    Args:
      step: the step, such as `symplectic_euler_step`.
      max_norm: largest norm of the cotangent of the state, > 0, in units of the loss over those of the state.
    Returns: a step of the same values.
    Raises: ValueError, if max_norm is not positive.
    Example:
      >>> import jax, jeuler
      >>> capped = jeuler.cap_cotangent(jeuler.euler_step, 2.0)
      >>> float(jax.grad(lambda y: 100 * capped(lambda t, y, args: y, 0.0, y, 1.0, None))(3.0))
      2.0

    Source: R. Pascanu, T. Mikolov, Y. Bengio, On the difficulty of training recurrent neural networks, ICML 2013,
      sect. 3.2.
    """
    checks.refuse_class("step must be a function (f, t, y, dt, args) -> y", step)
    checks.function("step", step, "(f, t, y, dt, args) -> y", "pass, say, jeuler.euler_step")
    checks.positive("max_norm", max_norm)
    return CappedStep(step, max_norm if checks.is_traced(max_norm) else float(max_norm))


@dataclasses.dataclass(frozen=True)
class CappedStep:
    """A step whose state passes back a cotangent of bounded norm; see `cap_cotangent`.

    It has no ``increment``, which compensated sums would add to y themselves, past the cap.
    """

    step: Step
    max_norm: float

    @property
    def __name__(self) -> str:
        return getattr(self.step, "__name__", "step")

    @property
    def order(self) -> int:
        return self.step.order  # type: ignore[attr-defined]  # a step need not have one; then this has none

    @property
    def with_info(self) -> Any:
        return self.step.with_info  # type: ignore[attr-defined]  # implicit steps have it

    def __call__(self, f: VectorField, t: Any, y: PyTree, dt: Any, args: Any) -> PyTree:
        return self.step(f, t, _capped(y, self.max_norm), dt, args)


@functools.partial(jax.custom_vjp, nondiff_argnums=(1,))
def _capped(y: PyTree, max_norm: Any) -> PyTree:
    """y, whose cotangent is scaled down to the norm max_norm where it is larger."""
    return y


def _capped_forward(y: PyTree, max_norm: Any) -> tuple[PyTree, None]:
    return y, None


def _capped_backward(max_norm: Any, _: None, cotangent: PyTree) -> tuple[PyTree]:
    # scaled by the largest entry first, so that the square does not overflow
    largest = trees.largest(cotangent)
    unit = jnp.where(largest > 0, largest, 1)
    norm = unit * jnp.sqrt(sum(jnp.sum(jnp.abs(c / unit) ** 2) for c in jax.tree.leaves(cotangent)))
    return (trees.scale(jnp.where(norm > max_norm, max_norm / norm, 1), cotangent),)


_capped.defvjp(_capped_forward, _capped_backward)
