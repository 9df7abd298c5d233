"""Springs with dampers between pairs of particles."""

from __future__ import annotations

from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jax import Array

from jeuler._core import checks
from jeuler._core.annotations import MovingParameter, OptionalParameter, ParticleIndices, default
from jeuler._core.component import component, replace, store_as_float
from jeuler._core.components import per_particle
from jeuler._core.in_time import at_time, moving
from jeuler._core.limits import check_limits
from jeuler._core.vectors import apart, direction, dot
from jeuler._jax.materialise import stored
from jeuler.forces.prepared import PreparedLinks, check_box, in_box
from jeuler.graphs.topology import topology


@jax.custom_jvp
def inverse_length(square: Array) -> Array:
    """1 / r from r^2; 0, and all derivatives 0, where the ends coincide (see `apart`)."""
    long = apart(square)
    return jnp.where(long, 1, 0) / jnp.where(long, jnp.sqrt(jnp.where(long, square, 1)), 1)


@inverse_length.defjvp
def _inverse_length_jvp(primals, tangents):
    i = inverse_length(*primals)
    change = (i / 2) * tangents[0]  # of r; i^3 by itself would overflow before i^2 does
    return i, -(i * i) * change


@jax.custom_jvp
def coefficient(square: Array, approach: Array, ks: Array, kd: Array, rest_length: Array) -> Array:
    """The force on the first end of a spring is c d, with d = p_i - p_j, r^2 = d.d and a = (v_i - v_j).d,

        c = (ks L - kd a / r) / r - ks

    At r = 0, c is the number -ks with all its derivatives 0 (see `apart`), so that for L = 0 the Jacobian there is
    -ks I. By r and not by `inverse_length`, which XLA would make a kernel of its own: a fifth of a forward run.
    """
    long = apart(square)
    r = jnp.sqrt(jnp.where(long, square, 1))
    return jnp.where(long, ks * rest_length - kd * (approach / r), 0) / r - ks


@coefficient.defjvp
def _coefficient_jvp(primals, tangents):
    """Written in i = 1 / r, which is computed once: what all derivatives share."""
    square, a, ks, kd, rest_length = primals
    i, a = inverse_length(square), stored(a)
    c = (ks * rest_length - kd * (a * i)) * i - ks
    by_r = (i * i) * (2 * kd * a * i - ks * rest_length)
    slopes = (by_r, -kd * (i * i), rest_length * i - 1, -a * (i * i), ks * i)
    changes = ((i / 2) * tangents[0], *tangents[1:])
    return c, dot(slopes, changes)


PARAMETERS = ("ks", "kd", "rest_length")


@component(static=("edges",), parameters=PARAMETERS, positive=PARAMETERS)
class Springs:
    """Linear springs and dampers between pairs of particles.

        d = p_i - p_j,  r = |d|,  u = d / r
        F_i = ks (L - r) u - kd ((v_i - v_j).u) u,   F_j = -F_i

    At r = 0 the direction u is taken as 0: the force is finite, and with L = 0 it is 0 with derivative exactly -ks I.

    Args:
      edges: the two particles (i, j) of each spring, integers (spring, 2). Static: part of the program. May be empty.
      ks: stiffness of each spring, shape () or (spring,), N/m, or a function of time ``ks(t)`` that returns it, as that
        of a muscle. Differentiable.
      kd: damping of each spring, shape () or (spring,), N s/m, or a function of time. Differentiable.
      rest_length: L, length without force, shape () or (spring,), m, or a function of time. Differentiable.
      box: (dim,), m, the sides of periodic space, in which d is that to the nearest image, no longer than half a side
        along each axis; None for free space. Differentiable.
    Returns: called as a force ``(t, position, velocity, mass)``, the force on each particle, (particle, dim), N.
    Raises: ValueError, if edges is not an integer (spring, 2) array or joins a particle to itself; in
      `simulate`, if an index is out of range, a parameter has another shape, or one that is not traced is negative.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> spring = jeuler.Springs([[0, 1]], ks=10.0, kd=0.0, rest_length=1.0)
      >>> spring(0.0, jnp.array([[0.0], [1.5]]), jnp.zeros((2, 1)), jnp.asarray(1.0)).tolist()
      [[5.0], [-5.0]]

    Source: D. Baraff, A. Witkin, Physically Based Modeling, SIGGRAPH course notes, 2001, particle systems, sect. 3.
    """

    edges: ParticleIndices
    ks: MovingParameter
    kd: MovingParameter
    rest_length: MovingParameter
    box: OptionalParameter = default(None)

    limits: ClassVar[dict[str, Any]] = {
        "ks": (">= 0", "N/m"), "kd": (">= 0", "N s/m"), "rest_length": (">= 0", "m"), "box": ("> 0", "m"),
    }  # fmt: skip

    def __post_init__(self) -> None:
        object.__setattr__(self, "edges", topology(self.edges))
        for name in PARAMETERS:
            if callable(getattr(self, name)):
                object.__setattr__(self, name, moving(f"Springs.{name}", getattr(self, name)))
            else:
                store_as_float(self, name)
        store_as_float(self, "box")

    def __call__(self, t: Any, position: Array, velocity: Array, mass: Array) -> Array:
        return self.at(t, position.dtype).laid_out(len(position), position.dtype)(t, position, velocity, mass)

    @property
    def is_moving(self) -> bool:
        """Whether a parameter is a function of time."""
        return any(callable(getattr(self, name)) for name in PARAMETERS)

    def at(self, t: Any, dtype: Any = None) -> Springs:
        """The springs with the numbers of time t in place of functions of time."""
        if not self.is_moving:
            return self
        return replace(self, **{name: at_time(getattr(self, name), t, dtype) for name in PARAMETERS})

    def prepare(self, context: Any) -> PreparedLinks | MovingSprings | None:
        """The springs between the living, laid out for the kernels; None where there are no springs."""
        if not len(self.edges):
            return None
        if self.is_moving:
            return MovingSprings(self, context.limits_drag, context.alive)
        return self.laid_out(context.particles, context.dtype, context.limits_drag).prepare(context)

    def laid_out(self, particles: int, dtype: Any, read_again: bool = False) -> PreparedLinks:
        """The same force with its parameters in the slots of each layout, which is the same work at every step."""
        layouts = self.edges.layouts(particles, shifts=self.box is None)
        values = [getattr(self, name).astype(dtype) for name in PARAMETERS]
        slots = [[layout.to_slots(x) for layout in layouts] for x in values]
        return PreparedLinks(self.edges, layouts, coefficient, PARAMETERS, read_again, slots, in_box(self.box, dtype))

    def energy(self, t: Any, position: Array, mass: Array) -> Array:
        """Potential energy sum ks (r - L)^2 / 2, J."""
        now = self.at(t, position.dtype)
        ks, rest_length = (per_particle(x.astype(position.dtype)) for x in (now.ks, now.rest_length))
        r, _ = direction(self.edges.difference(position, in_box(self.box, position.dtype)))
        return jnp.sum(ks * (r - rest_length) ** 2) / 2

    def tension(self, t: Any, state: Any) -> Array:
        """The pull of each spring on its ends, damper included: (spring,), N; negative where it pushes.

        T = ks (r - L) + kd (v_i - v_j).u

        The velocities are those of the state, as a run saves them: 0 of what is pinned, its own of what is prescribed.
        """
        ks, kd, rest_length, r, rate, here = self._now(t, state)
        return jnp.where(here, ks * (r - rest_length) + kd * rate, 0)

    def strain(self, t: Any, state: Any) -> Array:
        """How much longer each spring is than its rest length, (r - L) / L: (spring,); NaN where L = 0."""
        _, _, rest_length, r, _, here = self._now(t, state)
        has_length = rest_length > 0
        return jnp.where(here, jnp.where(has_length, r / jnp.where(has_length, rest_length, 1) - 1, jnp.nan), 0)

    def stored_energy(self, t: Any, state: Any) -> Array:
        """The energy in each spring, ks (r - L)^2 / 2: (spring,), J."""
        ks, _, rest_length, r, _, here = self._now(t, state)
        return jnp.where(here, ks * (r - rest_length) ** 2 / 2, 0)

    def damper_power(self, t: Any, state: Any) -> Array:
        """The power that each damper turns into heat, kd ((v_i - v_j).u)^2: (spring,), W."""
        _, kd, _, _, rate, here = self._now(t, state)
        return jnp.where(here, kd * rate**2, 0)

    def _now(self, t: Any, state: Any) -> tuple[Any, ...]:
        """ks, kd and L at time t; length and its rate of change; whether both ends live."""
        state.check()
        self.check(*state.position.shape)
        dtype = state.position.dtype
        now = self.at(t, dtype)
        r, u = direction(self.edges.difference(state.position, in_box(self.box, dtype)))
        rate = jnp.sum(self.edges.difference(state.velocity) * u, axis=1)
        here = True if state.alive is None else jnp.all(state.alive[self.edges[:]], axis=1)
        return now.ks.astype(dtype), now.kd.astype(dtype), now.rest_length.astype(dtype), r[:, 0], rate, here

    def check(self, particles: int, dim: int) -> None:
        self.edges.check(particles)
        for name in PARAMETERS:
            value = getattr(self, name)
            shape = (checks.form_of(f"Springs.{name}", at_time, value, 0.0) if callable(value) else value).shape
            checks.shape(f"Springs.{name}", shape, (), (len(self.edges),), meaning="one a spring")
        check_box(self, dim)
        check_limits(self)


@component(static=("read_again",))
class MovingSprings:
    """Springs with functions of time among their parameters, as they are in a run: laid out again at each time."""

    springs: Springs
    read_again: bool  # see `Layout.central_force`
    alive: Any = None

    def __call__(self, t: Any, position: Array, velocity: Array, mass: Array) -> Array:
        now = self.springs.at(t, position.dtype).laid_out(len(position), position.dtype, self.read_again)
        if self.alive is not None:
            now = now.only(jnp.all(self.alive[self.springs.edges[:]], axis=1))
        return now(t, position, velocity, mass)

    def prepare(self, context: Any) -> MovingSprings:
        """Between the living only."""
        return self if context.alive is None else replace(self, alive=context.alive)
