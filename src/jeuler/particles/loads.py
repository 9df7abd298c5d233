"""Forces that can be read: each by name, their sum, what supports hold, and what acted in a step."""

from __future__ import annotations

from collections import Counter
from typing import Any

import jax.numpy as jnp
from jax import Array

from jeuler._core.components import per_particle, stack
from jeuler.particles.equation import Attributes, Equation, add
from jeuler.particles.fields import name_of


def names_of(forces: tuple[Any, ...]) -> list[str]:
    """The name of each force, with its place among those of the same name where there are several."""
    names = [name_of(force) for force in forces]
    repeated, seen, unique = Counter(names), Counter[str](), []
    for name in names:
        unique.append(f"{name}[{seen[name]}]" if repeated[name] > 1 else name)
        seen[name] += 1
    return unique


def each_force(equation: Equation, t: Any, y: tuple[Array, Array], args: Attributes) -> dict[int, Array]:
    """What each force exerts on each particle, (particle, dim), by its place in the scene; 0 on dead slots."""
    attributes, x, v = equation.moving(t, y, args)
    forces = {}
    for share in equation.shares(t, x, v, attributes):
        place = int(share.name.partition("[")[2].partition("]")[0])  # "forces[2] Springs"
        forces[place] = of_the_living(stack(share.force), attributes)
    return forces


def loads(equation: Equation, t: Any, y: tuple[Array, Array], args: Attributes) -> Array:
    """The sum of the forces on each particle, pinned and prescribed ones too, without any limit on drag."""
    attributes, x, v = equation.moving(t, y, args)
    shares = [share.force for share in equation.shares(t, x, v, attributes)]
    return of_the_living(stack(add(shares, x)), attributes)


def of_the_living(force: Array, attributes: Attributes) -> Array:
    """The force, and 0 on dead slots."""
    return force if attributes.alive is None else jnp.where(per_particle(attributes.alive), force, 0)


def held(equation: Equation, t: Any, mass: Array, dtype: Any) -> Array:
    """Which particles do not follow the forces, being pinned or prescribed, (particle,)."""
    pinned = jnp.isinf(mass)
    for indices, *_ in equation.prescribed(t, dtype):
        pinned = pinned.at[indices].set(True)
    return pinned


def reactions(equation: Equation, t: Any, y: tuple[Array, Array], args: Attributes) -> Array:
    """What holds pinned and prescribed particles: m a - F, with no inertia where the mass is inf; 0 on all others."""
    force = loads(equation, t, y, args)
    mass = jnp.broadcast_to(jnp.asarray(args.mass, force.dtype), force.shape[:1])
    inertia = jnp.zeros_like(force)
    for indices, _, _, rate in equation.prescribed(t, force.dtype):
        inertia = inertia.at[indices].set(per_particle(jnp.where(jnp.isfinite(mass), mass, 0)[indices]) * rate)
    here = held(equation, t, mass, force.dtype)
    if args.alive is not None:
        here = here & args.alive
    return jnp.where(per_particle(here), inertia - force, 0)
