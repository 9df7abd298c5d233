"""Implicit steps: backward Euler by Newton's method, and its one-linear-solve form; derivatives by implicit functions.

``_newton`` solves; ``_jax.root`` and JAX's ``custom_linear_solve`` give the derivatives, in both modes and to any
order, at the price of one linear solve each.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from jeuler._core import checks, trees
from jeuler._core.arguments import says_what_to_write
from jeuler._jax.jaxpr import is_variable
from jeuler._jax.root import root
from jeuler.steps._newton import StepInfo, linear_solver_for, newton_then_damped, solve_linear
from jeuler.steps.explicit import VectorField

PyTree = Any


@says_what_to_write()
def implicit_euler(
    *,
    rtol: float | None = None,
    atol: float | None = None,
    max_steps: int = 50,
    damped_steps: int = 500,
    linear_solver: Any = None,
) -> ImplicitEuler:
    """Make a backward (implicit) Euler step with these tolerances.

        y(t + dt) = y + dt f(t + dt, y(t + dt), args)

    The equation is solved by Newton's method until the last correction of every unknown is below
    ``atol + rtol |unknown|`` or below roundoff. Where it does not get there in max_steps iterations, as in crushed nets
    of springs, damped iterations (pseudo-transient continuation) bring it near a solution and it starts again from
    there. A step that does not converge even so returns NaN, so that ``Solution.first_nonfinite`` names it;
    ``step.with_info`` returns ``(y, StepInfo)``. Derivatives are those of the exact solution (implicit function
    theorem), in reverse and forward mode and of any order, at one linear solve each. For y = (position, velocity) with
    a slope of position that does not depend on position, only the velocity is solved for.

    Args:
      rtol: relative tolerance of the unknowns; None: 1e-9 in float64, 1e-5 in float32.
      atol: absolute tolerance, in the units of the unknowns; None: 1e-3 rtol.
      max_steps: limit of Newton iterations.
      damped_steps: limit of damped iterations, which cost nothing where Newton's method converges; 0: none.
      linear_solver: a lineax solver; None: LU up to 128 unknowns, BiCGStab without a matrix above.
    Returns: a step ``(f, t, y, dt, args) -> y`` for `solve` and `simulate`. Its cumulative error is O(dt).
    Raises: ValueError, if a tolerance is not positive, max_steps is below 1 or damped_steps below 0.
    Example:
      >>> import jeuler
      >>> step = jeuler.implicit_euler(max_steps=100)
      >>> round(float(step(lambda t, y, args: -1e6 * (y - t), 0.0, 1.0, 0.1, None)), 4)
      0.1

    Source: E. Hairer, G. Wanner, Solving Ordinary Differential Equations II, 1996, sect. IV.3 and IV.8; damped
      iterations: C. T. Kelley, D. E. Keyes, SIAM J. Numer. Anal. 35, 1998.
    """
    for name, tolerance in (("rtol", rtol), ("atol", atol)):
        if tolerance is not None:
            checks.positive(name, tolerance)
    max_steps, damped_steps = checks.count("max_steps", max_steps, least=1), checks.count("damped_steps", damped_steps)
    check_linear_solver(linear_solver)
    return ImplicitEuler(rtol, atol, max_steps, damped_steps, linear_solver)


@dataclasses.dataclass(frozen=True)
class ImplicitEuler:
    """One backward (implicit) Euler step, solved to tolerance, with derivatives of the exact solution.

        y(t + dt) = y + dt f(t + dt, y(t + dt), args)

    Args:
      f: vector field, ``f(t, y, args) -> dy/dt``, of the structure of y.
      t: time, scalar, s.
      y: state, any pytree of floating or complex arrays.
      dt: step size, scalar, s. Every dt is stable where the equation itself is.
      args: passed to f; any pytree.
    Returns: the state at t + dt, NaN if it did not converge. Its cumulative error is O(dt).
    Raises: ValueError, at trace time, if y is neither floating nor complex. See `implicit_euler` for its tolerances.
    Example:
      >>> import jeuler
      >>> round(float(jeuler.implicit_euler_step(lambda t, y, args: -y, 0.0, 1.0, 1.0, None)), 6)
      0.5

    Source: E. Hairer, G. Wanner, Solving Ordinary Differential Equations II, 1996, sect. IV.3 and IV.8.
    """

    rtol: float | None = None
    atol: float | None = None
    max_steps: int = 50
    damped_steps: int = 500
    linear_solver: Any = None

    __name__ = "implicit_euler_step"
    order = 1

    def __call__(self, f: VectorField, t: Any, y: PyTree, dt: Any, args: Any) -> PyTree:
        return self.with_info(f, t, y, dt, args)[0]

    def with_info(self, f: VectorField, t: Any, y: PyTree, dt: Any, args: Any) -> tuple[PyTree, StepInfo]:
        """The state at t + dt, and how the iterations went."""
        system = _system(in_step(f, t, y, dt, args), t, y, dt, args)
        floor = system.roundoff
        if not floor.size:
            return y, StepInfo(jnp.asarray(True), jnp.int32(0))
        relative = self.rtol if self.rtol is not None else 1e-9 if floor.dtype == jnp.float64 else 1e-5
        scale = lax.stop_gradient(self.atol if self.atol is not None else 1e-3 * relative) + floor

        def scaled_residual(z):  # in units of the tolerance, so that solvers see numbers of one kind
            return system.residual(z * scale) / scale

        solve = newton_then_damped(
            rtol=relative,
            max_steps=self.max_steps,
            damped_steps=self.damped_steps,
            linear_solver=self.linear_solver or linear_solver_for(floor, rtol=1e-4, atol=0.1),
        )
        tangent_solve = functools.partial(solve_linear, solver=self.linear_solver)
        z, info = root(scaled_residual, system.start / scale, solve, tangent_solve)
        return system.state(z * scale * jnp.where(info.converged, 1, jnp.nan)), info


@says_what_to_write()
def linearly_implicit_euler(*, linear_solver: Any = None) -> LinearlyImplicitEuler:
    """Make a linearly implicit Euler step with this linear solver.

        y(t + dt) = y + w,   (I - dt J) w = dt f(t + dt, y, args),   J = df/dy at (t + dt, y)

    One linear solve: the first Newton iteration of backward Euler, from y. Exact backward Euler where f is linear in y.
    For springs it is the step of Baraff and Witkin: only the velocity is solved for.

    Args:
      linear_solver: a lineax solver; None: LU up to 128 unknowns, BiCGStab without a matrix above.
    Returns: a step ``(f, t, y, dt, args) -> y`` for `solve` and `simulate`; NaN where the linear solve failed. Its
      cumulative error is O(dt).
    Example:
      >>> import jeuler
      >>> step = jeuler.linearly_implicit_euler()
      >>> float(step(lambda t, y, args: -y, 0.0, 1.0, 1.0, None))
      0.5

    Source: E. Hairer, G. Wanner, Solving Ordinary Differential Equations II, 1996, sect. IV.9, eq. 9.25; D. Baraff,
      A. Witkin, Large Steps in Cloth Simulation, SIGGRAPH 1998, eq. 6.
    """
    check_linear_solver(linear_solver)
    return LinearlyImplicitEuler(linear_solver)


def check_linear_solver(solver: Any) -> None:
    """One ValueError if this is no lineax solver."""
    checks.refuse_class("linear_solver must be a lineax solver", solver)
    if solver is not None and not (hasattr(solver, "init") and hasattr(solver, "compute")):
        raise ValueError(f"linear_solver must be None or a lineax solver, got {solver!r}; write lineax.LU()")


@dataclasses.dataclass(frozen=True)
class LinearlyImplicitEuler:
    """One linearly implicit Euler step: the first Newton iteration of backward Euler, one linear solve.

        y(t + dt) = y + w,   (I - dt J) w = dt f(t + dt, y, args),   J = df/dy at (t + dt, y)

    Args:
      f: vector field, ``f(t, y, args) -> dy/dt``, of the structure of y.
      t: time, scalar, s.
      y: state, any pytree of floating or complex arrays.
      dt: step size, scalar, s.
      args: passed to f; any pytree.
    Returns: the state at t + dt, NaN where the linear solve failed. Its cumulative error is O(dt).
    Raises: ValueError, at trace time, if y is neither floating nor complex.
    Example:
      >>> import jeuler
      >>> round(float(jeuler.linearly_implicit_euler_step(lambda t, y, args: -y, 0.0, 1.0, 1.0, None)), 6)
      0.5

    Source: D. Baraff, A. Witkin, Large Steps in Cloth Simulation, SIGGRAPH 1998, eq. 6.
    """

    linear_solver: Any = None

    __name__ = "linearly_implicit_euler_step"
    order = 1

    def __call__(self, f: VectorField, t: Any, y: PyTree, dt: Any, args: Any) -> PyTree:
        y = checks.state("y", y)
        f = in_step(f, t, y, dt, args)
        slope, push = jax.linearize(lambda y: f(t + dt, y, args), y)

        def tangent_field(t, z, args):
            return trees.add(slope, push(trees.subtract(z, y)))

        system = _system(tangent_field, t, y, dt, args, velocity_decides=_velocity_decides(f, t, y, args))
        if not system.start.size:
            return y
        value, matvec = jax.linearize(system.residual, system.start)
        return system.state(system.start - solve_linear(matvec, value, solver=self.linear_solver))


implicit_euler_step: ImplicitEuler = implicit_euler()
linearly_implicit_euler_step: LinearlyImplicitEuler = linearly_implicit_euler()


def in_step(f: VectorField, t: Any, y: PyTree, dt: Any, args: Any) -> VectorField:
    """f as it is in the step from (t, y): with ``f.in_step(t, y, dt, args)``, if it has one, for what acts through the
    step and depends on where it ends, as forces of contact do."""
    return f.in_step(t, y, dt, args) if hasattr(f, "in_step") else f


class System(NamedTuple):
    """The equation of one step, ``residual(u) = 0`` for a real vector u."""

    start: Array  # u of the old state
    residual: Callable[[Array], Array]
    state: Callable[[Array], PyTree]  # the new y that u stands for
    roundoff: Array  # changes of u that cannot be told from rounding


def _system(f: VectorField, t: Any, y: PyTree, dt: Any, args: Any, velocity_decides: bool | None = None) -> System:
    """Backward Euler as an equation for y, or for the velocity alone where it decides the position.

    u - y - dt f(t + dt, u) = 0   or   u - v - dt a(t + dt, x + dt v(u), u) = 0
    """
    y = checks.state("y", y)

    def advance(z):
        return trees.add(y, trees.scale(dt, trees.in_dtypes_of(y, f(t + dt, z, args))))

    unknown = state = lambda z: z
    roundoff = trees.largest(y)
    if _velocity_decides(f, t, y, args) if velocity_decides is None else velocity_decides:
        (position, _), pair = trees.parts(y)
        roundoff = jnp.maximum(trees.largest(y), trees.largest(position) / jnp.abs(dt))

        def unknown(z):
            return pair.flatten_up_to(z)[1]

        def state(u):
            new_position, _ = pair.flatten_up_to(advance(pair.unflatten((position, u))))
            return pair.unflatten((new_position, u))

    start, from_vector = trees.real_vector(unknown(y))

    def residual(vector):
        return vector - trees.real_vector(unknown(advance(state(from_vector(vector)))))[0]

    eps = jnp.finfo(start.dtype).eps
    floor = jnp.full_like(start, lax.stop_gradient(10 * eps * roundoff))
    return System(start, residual, lambda vector: state(from_vector(vector)), floor)


def _velocity_decides(f: VectorField, t: Any, y: PyTree, args: Any) -> bool:
    """Whether y is a pair (position, velocity) and the traced slope of position makes no use of position."""
    parts, pair = trees.parts(y)
    if len(parts) != 2:
        return False
    jaxpr = jax.make_jaxpr(lambda position: f(t, pair.unflatten((position, parts[1])), args))(parts[0]).jaxpr
    touched = set(jaxpr.invars)

    def touches(variables):
        return any(is_variable(v) and v in touched for v in variables)

    for equation in jaxpr.eqns:
        if touches(equation.invars):
            touched.update(equation.outvars)
    return not touches(jaxpr.outvars[: len(jax.tree.leaves(parts[0]))])
