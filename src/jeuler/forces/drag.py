"""Drag: forces against the motion through the air, or along with it where it blows."""

from __future__ import annotations

import abc
from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jeuler._core import checks
from jeuler._core.annotations import AirParameter, Parameter, default
from jeuler._core.component import component, store_as_float
from jeuler._core.components import split, stack
from jeuler._core.limits import Limits, check_limits
from jeuler._core.vectors import dot, total
from jeuler._jax.materialise import kept, stored
from jeuler.forces.air import air_velocity, as_air, check_air


class Resistance(NamedTuple):
    """A drag at one time and place, -c u - q |u| u with u = v - w, by component.

    Attributes:
      linear: c, () or (particle,), kg/s; None where there is none.
      quadratic: q, () or (particle,), kg/m; None where there is none.
      air: w, one array (particle,) a component, m/s; None for air at rest.
    """

    linear: Any = None
    quadratic: Any = None
    air: Any = None

    def force(self, v: Sequence[Array]) -> list[Array]:
        """The force on each particle, one array (particle,) a component, N."""
        return self.through(v).force()

    def through(self, v: Sequence[Array]) -> Flow:
        """The same drag on particles of velocity v."""
        v = [kept(one) for one in v]
        u = v if self.air is None else [a - b for a, b in zip(v, self.air, strict=True)]
        return Flow(*self, u, None if self.quadratic is None else stored(length(u)))


class Flow(NamedTuple):
    """A drag on particles that move.

    Attributes:
      linear, quadratic, air: as in `Resistance`.
      u: v - w, one array (particle,) a component, m/s.
      speed: |u|, (particle,), m/s; None where there is no quadratic drag.
    """

    linear: Any
    quadratic: Any
    air: Any
    u: Sequence[Array]
    speed: Array | None

    def force(self) -> list[Array]:
        """The force on each particle, one array (particle,) a component, N."""
        parts = [] if self.linear is None else [[-self.linear * one for one in self.u]]
        if self.speed is not None:
            parts.append([-self.quadratic * self.speed * one for one in self.u])
        return [total(terms) for terms in zip(*parts, strict=True)]


def length(u: Sequence[Array]) -> Array:
    """|u|; 0 at u = 0 with its derivative."""
    return root(dot(u, u))


def root(x: Array) -> Array:
    """The square root of x >= 0; 0 at 0 with its derivative."""
    return jnp.where(x > 0, jnp.sqrt(jnp.where(x > 0, x, 1)), 0)


def acceleration(
    force: Sequence[Array], mass: Array, dt: Array, drags: Sequence[Flow], others: Sequence[Array]
) -> list[Array]:
    """F / max(m, dt kappa) by component, with which an explicit first-order step of dt does not overshoot, m/s^2.

        v' = v + dt F / max(m, dt kappa)

    F is the sum of all forces, and kappa bounds how fast the drags among them change with the velocity: by no more than
    kappa |v - v*| between v and v*, where they balance the other forces, which are held for the step. F is the slope of
    a convex function, so F.(v* - v) <= kappa |v* - v|^2: the step does not go beyond v*, and F = 0 there alone. Where
    dt kappa <= m this is m to the last bit.

        linear drags alone               kappa = c = sum c_i
        quadratic ones in one wind w     kappa = c/2 + q |v - w| + sqrt(c^2 + 4 q G) / 2,   q = sum q_j
        in several winds w_j             kappa = c/2 + sum q_j |v - w_j| + 2 B + sqrt((c - 2 B)^2 + 4 q G) / 2

    with w = sum q_j w_j / q, B = sum q_j |w_j - w| and G the size of all forces at the velocity w. In one wind the
    square root is the solution of (c + q |v* - w|) |v* - w| = G, so that a particle that moves along v* - w gets to v*
    in one step; in several it is a bound.

    |u| u is Lipschitz with |u| + |u*|, and |v* - w_j| <= R + |w_j - w|, where q R^2 + (c - 2 B) R = G bounds |v* - w|:
    (|a| a - |b| b).(a - b) >= r^3 - 2 |b| r^2 for r = |a - b|.
    """
    dt = jnp.broadcast_to(dt, ()).astype(mass.dtype)
    linear = [d.linear for d in drags if d.linear is not None]
    c = total(linear) if linear else jnp.zeros_like(mass)
    quadratic = [d for d in drags if d.speed is not None]
    if not quadratic:
        return quotient(force, longer(dt * c, mass))
    q, w, winds = _mean_wind(quadratic)
    slope = total(d.quadratic * d.speed for d in quadratic)
    at_w = [zero + share for zero, share in zip(_drag_at(w, drags), others, strict=True)]
    if linear or winds:
        spread = total(d.quadratic * length(wind) for d, wind in zip(quadratic, winds, strict=True)) if winds else 0
        slope, c = c / 2 + slope + 2 * spread, c / 2 - spread
    return limited(force, mass, dt, slope, c, q, at_w)


def longer(least: Array, mass: Array) -> Array:
    """The mass, or ``least`` where that is more."""
    return jnp.where((least > mass) & jnp.isfinite(least), least, mass)


@jax.custom_jvp
def quotient(force: Sequence[Array], mass: Array) -> list[Array]:
    """F / m by component."""
    return [one / mass for one in force]


@quotient.defjvp
def _quotient_jvp(primals, tangents):
    (force, mass), (dforce, dmass) = primals, tangents
    i = 1 / mass
    by_mass = i * jnp.broadcast_to(dmass, force[0].shape) if force else dmass  # summed once, not for each component
    return quotient(force, mass), [i * (df - i * one * by_mass) for one, df in zip(force, dforce, strict=True)]


@jax.custom_jvp
def limited(
    force: Sequence[Array], mass: Array, dt: Array, slope: Array, b: Array, q: Array, at_w: Sequence[Array]
) -> list[Array]:
    """F / max(m, dt (slope + sqrt(b^2 + q |F_w|))) by component; the root is 0 at 0, with its derivative."""
    m = longer(dt * (slope + root(b * b + q * length(at_w))), mass)
    return [one / m for one in force]


@limited.defjvp
def _limited_jvp(primals, tangents):
    """Written so that XLA makes few kernels of it, and few that wait for another: by 1 / max(m, ...), and by one over
    each root, not by the roots."""
    force, mass, dt, slope, b, q, at_w = primals
    dforce, dmass, ddt, dslope, db, dq, dat_w = tangents
    i = stored(1 / longer(dt * (slope + root(b * b + q * length(at_w))), mass))
    binds = i < 1 / mass
    by_size, size = inverse_root(dot(at_w, at_w))
    by_root, s = inverse_root(b * b + q * size)
    by_force = stored(by_root * by_size * q / 2)
    ds = by_force * dot(at_w, dat_w) + by_root * (b * db + size * dq / 2)
    dm = jnp.where(binds, dt * (dslope + ds) + (slope + s) * ddt, dmass)
    changes = [i * (df - i * one * dm) for one, df in zip(force, dforce, strict=True)]
    return limited(*primals), changes


def inverse_root(x: Array) -> tuple[Array, Array]:
    """1 / sqrt(x) and sqrt(x), x >= 0; 0 and 0 at 0."""
    normal = x >= jnp.finfo(x.dtype).tiny
    i = jnp.where(normal, jnp.sqrt(1 / jnp.where(normal, x, 1)), 0)
    return i, x * i


@jax.custom_jvp
def once(x: Array) -> Array:
    """x, computed once and stored; its cotangent is not."""
    return stored(x)


@once.defjvp
def _once_jvp(primals, tangents):
    return once(*primals), tangents[0]


def _mean_wind(quadratic: Sequence[Flow]) -> tuple[Array, Sequence[Array] | None, list[Any]]:
    """q, the mean wind w of quadratic drags (None: 0), and w_j - w of each; none of these where there is one wind."""
    q = total(d.quadratic for d in quadratic)
    blowing = [d for d in quadratic if d.air is not None]
    if len(quadratic) == 1 or not blowing:
        return q, quadratic[0].air, []
    safe = jnp.where(q > 0, q, 1)
    w = [total(d.quadratic * d.air[k] for d in blowing) / safe for k in range(len(blowing[0].air))]
    return (
        q,
        w,
        [[-b for b in w] if d.air is None else [a - b for a, b in zip(d.air, w, strict=True)] for d in quadratic],
    )


def _drag_at(w: Sequence[Array] | None, drags: Sequence[Flow]) -> Sequence[Any]:
    """The drags at the velocity w, by component; 0 where none acts there."""
    like = drags[0].u
    there = [Resistance(d.linear, d.quadratic, d.air) for d in drags if d.air is not w]
    if not there:
        return [0] * len(like)
    at = [jnp.zeros_like(one) for one in like] if w is None else w
    return [total(terms) for terms in zip(*(d.force(at) for d in there), strict=True)]


class _Drag(abc.ABC):
    """What the drags share."""

    coefficient: Array
    air: Any

    def __post_init__(self) -> None:
        store_as_float(self, "coefficient")
        check_limits(self)
        object.__setattr__(self, "air", as_air(self.air))

    @abc.abstractmethod
    def drag(self, t: Any, position: Array) -> Resistance:
        """The drag at one time and place."""

    def __call__(self, t: Any, position: Array, velocity: Array, mass: Array) -> Array:
        return stack(self.drag(t, position).force(split(velocity)))

    def _at(self, t: Any, position: Array) -> tuple[Array, Sequence[Array] | None]:
        """The coefficient, and the velocity of the air by component."""
        air = split(jnp.asarray(air_velocity(self.air, t, position))) if self.air else None
        return self.coefficient.astype(position.dtype), air

    def check(self, particles: int, dim: int) -> None:
        name = type(self).__name__
        checks.shape(f"{name}.coefficient", self.coefficient.shape, (), (particles,), meaning="one a particle")
        check_air(name, self.air, particles, dim)


@component(positive=("coefficient",))
class LinearDrag(_Drag):
    """Drag in proportion to the speed relative to the air (Stokes drag).

        F_i = -c (v_i - w(p_i, t)),   for a sphere of radius r in a fluid of viscosity mu: c = 6 pi mu r

    An explicit first-order step (`euler_step`, `symplectic_euler_step`) of `simulate` with c dt / m > 1 would overshoot
    the velocity at which drag balances the other forces. It gets there instead: all drags of the scene together, and
    the forces beside them, act on max(m, c dt) in place of m. Every equilibrium stays where it is; where c dt <= m, and
    under every other step, the force is as above.

    Args:
      coefficient: c, shape () or (particle,), kg/s, >= 0. Differentiable.
      air: the velocity w of the air: None at rest, (dim,) m/s, a field such as `Wind`, `Gust`, `Vortex` or
        `turbulence(...)`, any function ``air(t, position) -> (particle, dim)``, or a tuple of these, which add up.
    Returns: called as a force ``(t, position, velocity, mass)``, the force on each particle, (particle, dim), N.
    Raises: ValueError, in `simulate`, if the coefficient is negative, or it or the air has another shape.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> drag = jeuler.LinearDrag(0.5, air=[2.0, 0.0])
      >>> drag(0.0, jnp.zeros((1, 2)), jnp.array([[0.0, 4.0]]), jnp.asarray(1.0)).tolist()
      [[1.0, -2.0]]

    Source: G. G. Stokes, On the effect of the internal friction of fluids on the motion of pendulums, 1851.
    """

    coefficient: Parameter
    air: AirParameter = default(None)

    limits: ClassVar[Limits] = {"coefficient": (">= 0", "kg/s")}

    def drag(self, t: Any, position: Array) -> Resistance:
        """What `simulate` must know of the drag so that a step does not overshoot."""
        c, air = self._at(t, position)
        return Resistance(linear=c, air=air)


@component(positive=("coefficient",))
class QuadraticDrag(_Drag):
    """Drag in proportion to the square of the speed relative to the air.

        F_i = -c |u| u,   u = v_i - w(p_i, t),   for a body of area A in a fluid of density rho: c = rho C_d A / 2

    An explicit first-order step (`euler_step`, `symplectic_euler_step`) of `simulate` with c (|u| + |u*|) dt / m > 1
    would overshoot u*, the velocity relative to the air at which drag balances the other forces. It does not: all
    forces of the scene act on max(m, c (|u| + |u*|) dt) in place of m, and a particle that moves along u* gets there in
    one step. Every equilibrium stays where it is; where the limit does not bind, and under every other step, the force
    is as above.

    Args:
      coefficient: c, shape () or (particle,), kg/m, >= 0. Differentiable.
      air: the velocity w of the air: None at rest, (dim,) m/s, a field such as `Wind`, `Gust`, `Vortex` or
        `turbulence(...)`, any function ``air(t, position) -> (particle, dim)``, or a tuple of these, which add up.
    Returns: called as a force ``(t, position, velocity, mass)``, the force on each particle, (particle, dim), N.
      At the speed of the air the force and its derivative are zero.
    Raises: ValueError, in `simulate`, if the coefficient is negative, or it or the air has another shape.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> jeuler.QuadraticDrag(0.5)(0.0, jnp.zeros((1, 2)), jnp.array([[3.0, 4.0]]), jnp.asarray(1.0)).tolist()
      [[-7.5, -10.0]]

    Source: Lord Rayleigh, On the resistance of fluids, 1876.
    """

    coefficient: Parameter
    air: AirParameter = default(None)

    limits: ClassVar[Limits] = {"coefficient": (">= 0", "kg/m")}

    def drag(self, t: Any, position: Array) -> Resistance:
        """What `simulate` must know of the drag so that a step does not overshoot."""
        c, air = self._at(t, position)
        return Resistance(quadratic=c, air=air)
