"""The scene of forces and effects that moves particles."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jax import Array

from jeuler._core import checks
from jeuler._core.calls import with_previous
from jeuler._core.component import as_component, component, replace
from jeuler._core.signatures import signature_of
from jeuler.particles import loads
from jeuler.particles.equation import Attributes, Equation
from jeuler.particles.fields import declared, name_of, with_required_fields
from jeuler.particles.protocols import Context
from jeuler.particles.state import ParticleState


class _Announced:
    """The method `vector_field`, which warns where it is taken from a scene that has more than its forces."""

    def __init__(self, method: Callable[..., Any]) -> None:
        self.method = method
        self.__doc__ = method.__doc__

    def __get__(self, scene: Scene | None, owner: Any = None) -> Callable[..., Any]:
        if scene is None:
            return self.method
        names = effects_left_out(scene)
        if names:
            warnings.warn(
                f"scene.vector_field holds the forces and prescribed motion, without {', '.join(names)}: run the scene "
                f"by jeuler.simulate, or write scene.without_effects().vector_field where that is what you want",
                stacklevel=2,
            )
        return self.method.__get__(scene, owner)


@component()
class Scene:
    """The forces and effects that a system has: what is not listed is not in the traced program.

        dp/dt = v,   dv/dt = sum of forces / m

    A pytree whose leaves are all floating arrays, so ``jax.grad`` with respect to a whole scene works.

    Args:
      forces: functions ``(t, position, velocity, mass) -> (particle, dim)`` in N, such as `Springs` and `Gravity`.
        The mass is (particle,).
      effects: functions ``(t, dt, previous, state, key) -> state``, applied at each step in this order: births and
        deaths (`Emitter`, `Lifetime`, ...) before the motion, all others, such as `PrescribedMotion`, after it.
        ``previous`` is the state before the motion; functions without it, ``(t, dt, state, key) -> state``, do as well.
        What else forces and effects may have: `jeuler.particles.protocols`.
    Raises: ValueError, if a part is no function, or one of other arguments; in `simulate`, where a force or effect does
      not fit the state.
    Example:
      >>> import jax, jeuler
      >>> scene = jeuler.Scene(forces=(jeuler.Springs([[0, 1]], ks=10.0, kd=0.1, rest_length=1.0),))
      >>> jax.tree.map(lambda leaf: 2 * leaf, scene).forces[0].ks.item()
      20.0

    Source: A. Witkin, Particle System Dynamics, SIGGRAPH course notes, 1997, sect. 3.
    """

    forces: tuple[Any, ...] = ()
    effects: tuple[Any, ...] = ()

    def __post_init__(self) -> None:
        for name in ("forces", "effects"):
            parts = getattr(self, name)
            if not isinstance(parts, (tuple, list)):
                raise ValueError(f"Scene.{name} must be a tuple, got {type(parts).__name__}; write ({name[:-1]},)")
            for part in parts:
                _check_part(name, part)
            object.__setattr__(self, name, tuple(as_component(part) for part in parts))

    @_Announced
    def vector_field(self, t: Any, y: tuple[Array, Array], args: Any) -> tuple[Array, Array]:
        """The equation of motion, as `solve` and ``diffrax.ODETerm`` take it.

            (position, velocity) -> (velocity, acceleration)

        Effects other than prescribed motion are no part of it: a scene that has some warns, see `without_effects`.

        Args:
          t: time, s.
          y: the pair (position, velocity), each (particle, dim), m and m/s.
          args: the mass, () or (particle,), kg; a particle of mass inf does not move. Or what `Scene.attributes` makes
            of a state, which holds the further fields that forces read.
        Returns: the pair (velocity, acceleration), m/s and m/s^2.
        Raises: ValueError, at trace time, if a force reads a field and args is a mass.
        Example:
          >>> import jax.numpy as jnp, jeuler
          >>> scene = jeuler.Scene(forces=(jeuler.Gravity([-9.5]),))
          >>> velocity, acceleration = scene.vector_field(0.0, (jnp.zeros((1, 1)), jnp.ones((1, 1))), 2.0)
          >>> velocity.tolist(), acceleration.tolist()
          ([[1.0]], [[-9.5]])
        """
        context = Context(len(y[0]), y[0].dtype)
        return Equation.of(self.forces, self.effects, context).vector_field(t, y, args)

    def without_effects(self) -> Scene:
        """The scene of its forces and prescribed motion alone: all of what `vector_field` holds.

        Returns: `Scene`, this one if it has no other effects.
        Example:
          >>> import jeuler
          >>> scene = jeuler.Scene(forces=(jeuler.Gravity([-9.8]),), effects=(jeuler.SpeedLimit(3.0),))
          >>> scene.without_effects().effects
          ()
        """
        if not effects_left_out(self):
            return self
        return replace(self, effects=tuple(effect for effect in self.effects if hasattr(effect, "prescribe")))

    def attributes(self, state: ParticleState) -> Attributes:
        """What `vector_field` takes as args: the mass, and with it only those fields that some force reads.

        A dead slot has infinite mass there: it feels no force.
        """
        names = {name for part in self.forces for name in declared(part, "reads")} - {"mass", "alive"}
        others = {name: getattr(state, name) for name in sorted(names)}
        mass = state.mass if state.alive is None else jnp.where(state.alive, state.mass, jnp.inf)
        return Attributes(mass, state.alive, others or None)

    def as_equation(self, state: ParticleState) -> tuple[tuple[Array, Array], Attributes]:
        """What `solve` takes with `vector_field` to move this state: the pair (y0, args).

        y0 = (position, velocity)
        """
        checks.kind("state", state, ParticleState)
        state.check()
        state = with_required_fields(state, self.forces, self.effects)
        self.check(state)
        return (state.position, state.velocity), self.attributes(state)

    def force(self, t: Any, state: ParticleState) -> Array:
        """The sum of the scene's forces on each particle, pinned and prescribed ones too.

            F_i = sum of forces on i

        At a pinned or prescribed particle it is the load on the support, what a load cell there shows; `reactions` is
        what the support exerts. Effects, such as impacts of `Collisions`, are no part of it: see ``state.force``.

        Args:
          t: time, (), s.
          state: the particles at that time. ``jax.vmap(scene.force)(solution.t, solution.y)`` reads a whole run.
        Returns: (particle, dim), N; 0 on a dead slot.
        Raises: ValueError, if the state does not fit the scene, or has an axis of times.
        Example:
          >>> import jeuler
          >>> spring = jeuler.Springs([[0, 1]], ks=10.0, kd=0.0, rest_length=1.0)
          >>> scene = jeuler.Scene((spring, jeuler.Gravity([-8.0])))
          >>> state = jeuler.ParticleState([[0.0], [-1.5]], [[0.0], [0.0]], mass=[float("inf"), 0.5])
          >>> scene.force(0.0, state).tolist(), scene.reactions(0.0, state).tolist()
          ([[-5.0], [1.0]], [[5.0], [0.0]])
        """
        equation, y, args = self._at(state)
        return loads.loads(equation, t, y, args)

    def forces_by_name(self, t: Any, state: ParticleState) -> dict[str, Array]:
        """What each force of the scene exerts on each particle: their sum is `force`.

        Args:
          t: time, (), s.
          state: the particles at that time.
        Returns: by the name of the force's class or function, (particle, dim), N. Where several have one name, they
          are counted from 0 in the order of the scene: "Springs[0]", "Springs[1]".
        Raises: ValueError, as `force`.
        Example:
          >>> import jeuler
          >>> scene = jeuler.Scene((jeuler.LinearDrag(0.5), jeuler.Gravity([-8.0])))
          >>> state = jeuler.ParticleState([[0.0]], [[2.0]], mass=0.5)
          >>> {name: force.tolist() for name, force in scene.forces_by_name(0.0, state).items()}
          {'LinearDrag': [[-1.0]], 'Gravity': [[-4.0]]}
        """
        equation, y, args = self._at(state)
        each = loads.each_force(equation, t, y, args)
        nothing = jnp.zeros_like(y[0])
        return {name: each.get(k, nothing) for k, name in enumerate(loads.names_of(self.forces))}

    def reactions(self, t: Any, state: ParticleState) -> Array:
        """What the supports exert on pinned and prescribed particles.

            R_i = m_i a_i - F_i

        a_i is that of the path of a prescribed particle, and 0 of a pinned one. A prescribed particle of mass inf has
        no inertia here.

        Args:
          t: time, (), s.
          state: the particles at that time.
        Returns: (particle, dim), N; 0 on particles that are free.
        Raises: ValueError, as `force`.
        """
        equation, y, args = self._at(state)
        return loads.reactions(equation, t, y, args)

    def _at(self, state: ParticleState) -> tuple[Equation, tuple[Array, Array], Attributes]:
        """The equation for this state, its position and velocity, and its attributes."""
        y, args = self.as_equation(state)
        return Equation.of(self.forces, self.effects, Context(len(y[0]), y[0].dtype)), y, args

    def energy(self, t: Any, y: tuple[Array, Array], mass: Any) -> Array:
        """Kinetic and potential energy of the particles that can move, J; of the forces that have a potential.

        E = sum_i m_i |v_i|^2 / 2 + sum of the forces' energies
        """
        position, velocity = y
        mass = jnp.broadcast_to(jnp.asarray(mass, dtype=position.dtype), position.shape[:1])
        moving = jnp.isfinite(mass)
        kinetic = jnp.sum(jnp.where(moving, mass, 0) * jnp.sum(velocity**2, axis=-1)) / 2
        return kinetic + sum(part.energy(t, position, mass) for part in self.forces if hasattr(part, "energy"))

    def check(self, state: ParticleState) -> None:
        """One ValueError that says which force or effect does not fit the state."""
        for part in (*self.forces, *self.effects):
            if hasattr(part, "check"):
                part.check(*state.position.shape)


def effects_left_out(scene: Scene) -> tuple[str, ...]:
    """The names of the effects that `vector_field` does not hold."""
    return tuple(name_of(effect) for effect in scene.effects if not hasattr(effect, "prescribe"))


def _check_part(name: str, part: Any) -> None:
    """One ValueError if this cannot be one of Scene.forces or Scene.effects; which it is, its arguments say."""
    expected = f"Scene.{name} must hold functions such as Gravity(...) or Lifetime(...)"
    checks.refuse_class(expected, part)
    if not callable(part):
        hint = "; a collider acts through Collisions((...,)) or PenaltyContact" if hasattr(part, "normal") else ""
        raise ValueError(f"{expected}, got {checks.shown(part)}{hint}")
    signature = signature_of(part)
    arguments = set(signature.parameters) if signature else set()
    if name == "forces" and {"dt", "state"} <= arguments:
        raise ValueError(f"{name_of(part)} is an effect, (t, dt, state, key) -> state; put it in Scene.effects")
    if name == "effects" and {"position", "velocity"} <= arguments:
        raise ValueError(f"{name_of(part)} is a force, (t, position, velocity, mass) -> N; put it in Scene.forces")
    if name == "forces" and signature and not hasattr(part, "prepare"):
        try:
            signature.bind(*[None] * 4, **dict.fromkeys(declared(part, "reads")))
        except TypeError:
            raise ValueError(
                f"Scene.forces must hold functions (t, position, velocity, mass) -> N, got {name_of(part)}{signature}; "
                f"all four arguments are passed, also those that it does not need"
            ) from None
    if name == "effects":
        with_previous(part, name_of(part))
