"""The implicit midpoint rule: second order, without the damping of implicit Euler."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax

from jeuler.steps._newton import StepInfo
from jeuler.steps.explicit import VectorField
from jeuler.steps.implicit import ImplicitEuler, implicit_euler_step

PyTree = Any


@dataclasses.dataclass(frozen=True)
class ImplicitMidpoint:
    """One step of the implicit midpoint rule, solved to tolerance, with derivatives of the exact solution.

        y(t + dt) = y + dt f(t + dt/2, (y + y(t + dt)) / 2, args)

    It is half a step of implicit Euler, and as much again in the same direction. Quadratic invariants, such as the
    energy of linear springs without dampers, stay as they are at any dt, where implicit Euler takes energy out; what is
    too stiff for dt rings on with the wrong period instead of dying out. Contact at rest is not part of its equation,
    as it is of `implicit_euler_step`: `Collisions` act after it, and the force in a stiff spring that stands on a floor
    is not to be read.

    Args:
      f: vector field, ``f(t, y, args) -> dy/dt``, of the structure of y.
      t: time, scalar, s.
      y: state, any pytree of floating or complex arrays.
      dt: step size, scalar, s. Every dt is stable where the equation is linear and stable.
      args: passed to f; any pytree.
    Returns: the state at t + dt, NaN if it did not converge. Its cumulative error is O(dt^2).
    Raises: ValueError, at trace time, if y is neither floating nor complex.
    Example:
      >>> import jeuler
      >>> x, v = jeuler.implicit_midpoint_step(lambda t, y, args: (y[1], -100 * y[0]), 0.0, (1.0, 0.0), 0.2, None)
      >>> round(float(x), 6), round(float(v), 6), round(float(100 * x**2 + v**2), 3)
      (0.0, -10.0, 100.0)

    Source: E. Hairer, C. Lubich, G. Wanner, Geometric Numerical Integration, 2006, eq. II.1.7 and sect. IV.2.
    """

    half: ImplicitEuler = implicit_euler_step

    __name__ = "implicit_midpoint_step"
    order = 2
    solves_contact = False  # the end of its half step is not where contact is to hold

    def __call__(self, f: VectorField, t: Any, y: PyTree, dt: Any, args: Any) -> PyTree:
        return self.with_info(f, t, y, dt, args)[0]

    def with_info(self, f: VectorField, t: Any, y: PyTree, dt: Any, args: Any) -> tuple[PyTree, StepInfo]:
        """The state at t + dt, and how the iterations went."""
        middle, info = self.half.with_info(f, t, y, dt / 2, args)
        return jax.tree.map(lambda y, m: (2 * m - y).astype(m.dtype), y, middle), info


implicit_midpoint_step = ImplicitMidpoint()
