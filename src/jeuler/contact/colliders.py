"""Colliders: solid shapes as signed distances, ``collider(t, point) -> distance``, negative inside the solid.

Any function of that signature is a collider, best with a gradient of length one (a true signed distance), since
contact is searched for along the path in strides of that length.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jeuler._core import checks
from jeuler._core.annotations import MovingParameter, Parameter
from jeuler._core.component import as_component, component, store_as_float
from jeuler._core.in_time import at_time
from jeuler._core.vectors import length, unit

Collider = Callable[[Any, Array], Array]


def normal_and_speed(collider: Collider, t: Any, point: Array) -> tuple[Array, Array]:
    """The outward unit normal at a point, and the speed with which the surface recedes from it, m/s."""
    t = jnp.asarray(t, point.dtype)
    recession, slope = jax.grad(collider, argnums=(0, 1))(t, point)
    return unit(slope), recession


def moves(collider: Collider, dim: int) -> bool:
    """Whether its distance depends on the time."""
    if isinstance(collider, _Shape):
        return collider.moves
    program = jax.make_jaxpr(collider)(jnp.zeros(()), jnp.zeros(dim)).jaxpr
    time, _ = program.invars
    return any(x is time for used in (program.outvars, *(equation.invars for equation in program.eqns)) for x in used)


class _Shape:
    """What the shapes share: parameters as arrays, places that may move, a check of their dimension."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if callable(value):
                where = f"{type(self).__name__}.{name}"
                checks.refuse_class(f"{where} must be a vector or a function of time", value)
                checks.function(where, value, "(t) -> (dim,)", "it gets the time, in s")
                object.__setattr__(self, name, as_component(value))
            elif name == "inside":
                checks.true_or_false(f"{type(self).__name__}.inside", value)
            else:
                store_as_float(self, name)

    @property
    def moves(self) -> bool:
        """Whether its place is a function of time."""
        return any(callable(value) for value in vars(self).values())

    @property
    def convex(self) -> bool:
        """Whether the solid is convex and does not move, so that its distance along a straight path is convex."""
        return not self.moves and not getattr(self, "inside", False)

    def check(self, dim: int) -> None:
        for name, value in vars(self).items():
            where = f"{type(self).__name__}.{name}"
            form = checks.form_of(where, value, jnp.zeros(())) if callable(value) else value
            shape = getattr(form, "shape", ())
            if shape not in ((), (dim,)) or (shape == () and name in ("point", "normal", "center")):
                raise ValueError(
                    f"{type(self).__name__}.{name} must have shape ({dim},), one component for each of position's, "
                    f"got {shape}"
                )
            if callable(value) or checks.is_traced(value):
                continue
            checks.finite(where, value, infinite=name == "half_size")
            if name in ("radius", "half_size") and not np.all(np.asarray(value) >= 0):
                raise ValueError(f"{type(self).__name__}.{name} must be at least 0 m, got {value}")
            if name == "normal" and not np.any(np.asarray(value)):
                raise ValueError(
                    f"{type(self).__name__}.normal must point somewhere, got {value}; it points out of the solid"
                )


@component()
class Plane(_Shape):
    """A half-space: solid on the side against the normal.

        distance = (p - point).n / |n|

    Args:
      point: any point of the surface, (dim,), m; or a function ``t -> (dim,)``, such as `SampledPath`.
      normal: outward direction of any length, (dim,). Differentiable.
    Returns: called as ``(t, point)`` with a point (dim,), the signed distance, (), m.
    Raises: ValueError, in `simulate`, if a shape is not (dim,).
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> float(jeuler.Plane(point=[0.0, 1.0], normal=[0.0, 2.0])(0.0, jnp.array([5.0, 4.0])))
      3.0

    Source: C. Ericson, Real-Time Collision Detection, 2005, sect. 5.1.1.
    """

    point: MovingParameter
    normal: Parameter

    def __call__(self, t: Any, point: Array) -> Array:
        return (point - at_time(self.point, t, point.dtype)) @ unit(self.normal.astype(point.dtype))


@component(static=("inside",))
class Sphere(_Shape):
    """A ball (in two dimensions a disc), or the wall around one.

        distance = |p - center| - radius      (inside=True: the negative of it)

    Args:
      center: (dim,), m; or a function ``t -> (dim,)``, such as `SampledPath`. Differentiable.
      radius: (), m. Differentiable.
      inside: False: particles stay outside; True: particles stay inside.
    Returns: called as ``(t, point)`` with a point (dim,), the signed distance, (), m.
    Raises: ValueError, in `simulate`, if a shape does not fit.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> float(jeuler.Sphere(center=[0.0, 0.0], radius=1.0)(0.0, jnp.array([3.0, 4.0])))
      4.0

    Source: C. Ericson, Real-Time Collision Detection, 2005, sect. 5.2.
    """

    center: MovingParameter
    radius: Parameter
    inside: bool = False

    def __call__(self, t: Any, point: Array) -> Array:
        outside = length(point - at_time(self.center, t, point.dtype)) - self.radius.astype(point.dtype)
        return -outside if self.inside else outside


@component()
class Box(_Shape):
    """An axis-aligned box.

        q = |p - center| - half_size,   distance = |max(q, 0)| outside, max_k q_k inside

    Args:
      center: (dim,), m; or a function ``t -> (dim,)``, such as `SampledPath`. Differentiable.
      half_size: half of each edge, () or (dim,), m. Differentiable.
    Returns: called as ``(t, point)`` with a point (dim,), the signed distance, (), m.
    Raises: ValueError, in `simulate`, if a shape does not fit.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> float(jeuler.Box(center=[0.0, 0.0], half_size=[1.0, 2.0])(0.0, jnp.array([4.0, 6.0])))
      5.0

    Source: I. Quilez, Distance functions, iquilezles.org, 2008 (box, exact).
    """

    center: MovingParameter
    half_size: Parameter

    def __call__(self, t: Any, point: Array) -> Array:
        q = jnp.abs(point - at_time(self.center, t, point.dtype)) - self.half_size.astype(point.dtype)
        deepest = jnp.max(q)
        return jnp.where(deepest > 0, length(jnp.maximum(q, 0)), deepest)


def as_collider(name: str, collider: Any) -> Any:
    """A collider as a pytree; one ValueError if it is none."""
    checks.refuse_class(f"{name} must be a Plane, Sphere, Box or a function (t, point) -> ()", collider)
    hint = "pass a Plane, Sphere, Box or a signed distance, (t, point) -> ()"
    checks.function(name, collider, "(t, point) -> ()", hint)
    return as_component(collider)


def check_collider(collider: Any, dim: int) -> None:
    """One ValueError where a collider does not fit the dimension of the positions."""
    if hasattr(collider, "check"):
        collider.check(dim)
    form = checks.form_of("a collider", collider, jnp.zeros(()), jnp.zeros(dim))
    if getattr(form, "shape", None) != () or not jnp.issubdtype(form.dtype, jnp.floating):
        came = f"{form.dtype} of shape {form.shape}" if hasattr(form, "shape") else f"a {type(form).__name__}"
        raise ValueError(f"a collider must return one signed distance, a float of shape (), for a point, got {came}")
