"""Forces between particles that are near each other, whoever they are: by the rows that `Neighbours` makes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from jeuler._core import checks
from jeuler._core.annotations import Parameter, default
from jeuler._core.component import component, replace, store_as_float
from jeuler._core.components import mass_that_feels, split, stack
from jeuler._core.limits import check_limits
from jeuler._core.vectors import apart, dot
from jeuler._jax.materialise import stored
from jeuler.graphs.cells import NOT_BUILT, nearest_image


class Pairs(NamedTuple):
    """Each particle with those in its row, (particle, capacity), by component.

    Attributes:
      who: index of the neighbour, 0 where there is none.
      here: whether there is one, alive, within the cutoff, and not in the same place.
      d: p_i - p_j to its nearest image.
      r: its length; 1 where there is none.
    """

    who: Array
    here: Array
    d: list[Array]
    r: Array

    def of(self, x: Any) -> list[Array]:
        """Of arrays (particle,), one a component, the neighbours' values."""
        return [stored(one[self.who]) for one in x]

    def sum(self, terms: Array) -> Array:
        """The sum over a particle's neighbours, (particle,)."""
        return jnp.sum(jnp.where(self.here, terms, 0), axis=1)


class _Nearby:
    """What the forces share."""

    neighbours: Any
    alive: Any

    reads: ClassVar[tuple[str, ...]] = ("neighbours", "neighbours_made_at", "has_neighbours")

    def _store(self, *names: str) -> None:
        name = type(self).__name__
        if not hasattr(self.neighbours, "cell_capacity"):
            came = checks.shown(self.neighbours)
            raise ValueError(f"{name}.neighbours must be a Neighbours, listed in Scene.effects too, got {came}")
        store_as_float(self, *names)
        check_limits(self)

    def prepare(self, context: Any) -> Any:
        """Only between the living."""
        return self if context.alive is None else replace(self, alive=context.alive)

    def check(self, particles: int, dim: int) -> None:
        self.neighbours.check(particles, dim)

    def __call__(
        self,
        t: Any,
        position: Array,
        velocity: Array,
        mass: Array,
        neighbours: Array,
        neighbours_made_at: Array | None = None,
        has_neighbours: Array | None = None,
    ) -> Array:
        """The sum of what the neighbours exert; NaN where rows were never made."""
        rows = self._rows_at(position, neighbours, neighbours_made_at, has_neighbours)
        total = self._total(rows, has_neighbours, position, velocity, mass)
        return jnp.where(rows[:, :1] == NOT_BUILT, jnp.nan, total)

    def _total(self, rows: Array, made: Array | None, position: Array, velocity: Array, mass: Array) -> Array:
        """What those in the rows exert, (particle, dim)."""
        pairs = self._pairs(position, rows, made)
        shares = self._shares(pairs, position, split(velocity), mass)
        return stack([pairs.sum(share) for share in shares])

    def _rows_at(self, position: Array, rows: Array, made_at: Array | None, has: Array | None) -> Array:
        """The rows for these positions, those of the state or new ones."""
        if made_at is None or has is None:
            return rows
        return self.neighbours.rows_at(position, rows, made_at, has, self.alive)

    def _pairs(self, position: Array, rows: Array, made: Array | None) -> Pairs:
        dtype, x = position.dtype, split(position)
        box = self.neighbours.box
        boxes = [None] * len(x) if box is None else list(box.astype(dtype))
        here = (rows >= 0) & (rows < len(position))  # a window may have left a dead one behind
        who = jnp.where(here, rows, 0)
        # stored: each of several sums over the rows would look them up again
        d = [stored(nearest_image(one[:, None] - one[who], side)) for one, side in zip(x, boxes, strict=True)]
        square = dot(d, d)
        here = here & apart(square) & (square < self.neighbours.cutoff.astype(dtype) ** 2)
        if self.alive is not None:
            here = here & self.alive[who] & self.alive[:, None]
            if made is not None:  # a newborn is seen, and sees, once it has a row: from its second step on
                here = here & made[who] & made[:, None]
        return Pairs(who, here, d, jnp.sqrt(jnp.where(here, square, 1)))

    def _shares(self, pairs: Pairs, position: Array, v: Sequence[Array], mass: Array) -> list[Array]:
        """What each neighbour exerts, (particle, capacity) for each component."""
        raise NotImplementedError


@component(static=(), parameters=("diameter", "ks", "kd"), positive=("diameter", "ks", "kd"))
class SoftRepulsion(_Nearby):
    """Particles that push each other apart where they overlap: a crowd, grains, a rope that does not cut itself.

        F_i = ks (s - r) u - kd (s - r) / s ((v_i - v_j).u) u  where r = |p_i - p_j| < s,   F_j = -F_i

    The damper sets in with the overlap, so that the force has no jump.

    Args:
      neighbours: the `Neighbours` of the scene, in its effects too; their cutoff is at least the diameter.
      diameter: s, (), m: the distance at which two touch. Differentiable.
      ks: (), N/m. Differentiable.
      kd: (), N s/m. Differentiable.
    Returns: called as a force ``(t, position, velocity, mass, neighbours, neighbours_made_at, has_neighbours)``,
      (particle, dim), N; NaN where the state's rows were never made, as outside of a run, or are too short at a stage
      of a step. A newborn has its row from its second step on.
    Raises: ValueError, if neighbours are none or a number is negative; in `simulate`, if the diameter is above the
      cutoff.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> near = jeuler.Neighbours(cutoff=1.0, skin=0.2, capacity=4)
      >>> scene = jeuler.Scene((jeuler.SoftRepulsion(near, diameter=1.0, ks=8.0),), (near,))
      >>> state = jeuler.ParticleState([[0.0], [0.5]], jnp.zeros((2, 1)))
      >>> jeuler.simulate(scene, state, dt=0.5, num_steps=1).y.velocity[-1].tolist()
      [[-2.0], [2.0]]

    Source: P. A. Cundall, O. D. L. Strack, A discrete numerical model for granular assemblies, Geotechnique 29, 1979.
    """

    neighbours: Any
    diameter: Parameter
    ks: Parameter
    kd: Parameter = default(0.0)
    alive: Any = None

    limits: ClassVar[dict[str, Any]] = {"diameter": ("> 0", "m"), "ks": (">= 0", "N/m"), "kd": (">= 0", "N s/m")}
    axes: ClassVar[dict[str, int]] = {"diameter": 0, "ks": 0, "kd": 0}

    def __post_init__(self) -> None:
        self._store("diameter", "ks", "kd")

    def _shares(self, pairs: Pairs, position: Array, v: Sequence[Array], mass: Array) -> list[Array]:
        s, ks, kd = (x.astype(position.dtype) for x in (self.diameter, self.ks, self.kd))
        overlap = jnp.maximum(s - pairs.r, 0)
        approach = dot([a[:, None] - b for a, b in zip(v, pairs.of(v), strict=True)], pairs.d) / pairs.r
        c = overlap * (ks - kd / s * approach) / pairs.r
        return [c * one for one in pairs.d]

    def check(self, particles: int, dim: int) -> None:
        self.neighbours.check(particles, dim)
        traced = checks.is_traced(self.diameter) or checks.is_traced(self.neighbours.cutoff)
        if not traced and float(self.diameter) > float(self.neighbours.cutoff) * (1 + 1e-6):
            raise ValueError(
                f"SoftRepulsion.diameter must be at most the cutoff of its neighbours, "
                f"{float(self.neighbours.cutoff):g} m, got {float(self.diameter):g} m"
            )


@component(parameters=("separation", "alignment", "cohesion"), positive=("separation", "alignment", "cohesion"))
class Flocking(_Nearby):
    """Boids: each keeps its distance from those it sees, goes their way, and stays with them.

        w_ij = (1 - r^2 / R^2)^2,  n_i = e + sum_j w_ij,  R the cutoff of the neighbours
        F_i = m_i / n_i sum_j w_ij (separation R (p_i - p_j) / r^2 + alignment (v_j - v_i) + cohesion (p_j - p_i))

    The weights fall to 0 at the cutoff, and e = 0.01, so that the force has no jump where one comes into sight.

    Args:
      neighbours: the `Neighbours` of the scene, in its effects too.
      separation: (), m/s^2. Differentiable.
      alignment: (), 1/s. Differentiable.
      cohesion: (), 1/s^2. Differentiable.
    Returns: called as a force ``(t, position, velocity, mass, neighbours, neighbours_made_at, has_neighbours)``,
      (particle, dim), N; NaN where the state's rows were never made, as outside of a run, or are too short at a stage
      of a step. A newborn has its row from its second step on.
    Raises: ValueError, if neighbours are none or a number is negative.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> near = jeuler.Neighbours(cutoff=2.0, skin=0.2, capacity=4)
      >>> scene = jeuler.Scene((jeuler.Flocking(near, separation=0.0, alignment=1.0, cohesion=0.0),), (near,))
      >>> state = jeuler.ParticleState([[0.0], [1.0]], [[1.0], [0.0]])
      >>> end = jeuler.simulate(scene, state, dt=0.1, num_steps=50).y.velocity[-1]
      >>> bool(abs(end[0] - end[1])[0] < 0.01)
      True

    Source: C. W. Reynolds, Flocks, Herds, and Schools: A Distributed Behavioral Model, SIGGRAPH 1987.
    """

    neighbours: Any
    separation: Parameter
    alignment: Parameter
    cohesion: Parameter
    alive: Any = None

    limits: ClassVar[dict[str, Any]] = {
        "separation": (">= 0", "m/s^2"), "alignment": (">= 0", "1/s"), "cohesion": (">= 0", "1/s^2"),
    }  # fmt: skip
    axes: ClassVar[dict[str, int]] = {"separation": 0, "alignment": 0, "cohesion": 0}

    def __post_init__(self) -> None:
        self._store("separation", "alignment", "cohesion")

    def _shares(self, pairs: Pairs, position: Array, v: Sequence[Array], mass: Array) -> list[Array]:
        a, b, c = (x.astype(position.dtype) for x in (self.separation, self.alignment, self.cohesion))
        reach = self.neighbours.cutoff.astype(position.dtype)
        square = pairs.r**2
        w = jnp.where(pairs.here, (1 - square / reach**2) ** 2, 0)
        along = w * (a * reach / square - c)
        share = mass_that_feels(mass) / (0.01 + pairs.sum(w))
        shares = [along * d + b * w * (vj - vi[:, None]) for d, vi, vj in zip(pairs.d, v, pairs.of(v), strict=True)]
        return [share[:, None] * one for one in shares]


@component(
    parameters=("mass", "density", "stiffness", "viscosity"), positive=("mass", "density", "stiffness", "viscosity")
)
class Fluid(_Nearby):
    """A fluid of particles (SPH): density from those around, pressure from density, and viscosity.

        rho_i = m sum_j W(r_ij) + m W(0),   p_i = stiffness max(rho_i - density, 0)
        F_i = m^2 sum_j ((p_i / rho_i^2 + p_j / rho_j^2) g d + 2 viscosity / (rho_i rho_j) g (v_j - v_i))
        g = -W'(r) / r,   d = p_i - p_j

    W(r) = C (1 - r^2 / R^2)^3 up to the cutoff R of the neighbours, its integral over space 1. stiffness is
    the square of the speed of sound. Momentum is kept; pinned particles are a wall of the same fluid.

    Args:
      neighbours: the `Neighbours` of the scene, in its effects too; some 20 within the cutoff in the plane, 40
        in space.
      mass: m, the mass that each particle stands for, (), kg. Differentiable.
      density: that at rest, (), kg/m^dim. Differentiable.
      stiffness: (), m^2/s^2. Differentiable.
      viscosity: dynamic, (), Pa s in space. Differentiable.
    Returns: called as a force ``(t, position, velocity, mass, neighbours, neighbours_made_at, has_neighbours)``,
      (particle, dim), N; NaN where the state's rows were never made, as outside of a run, or are too short at a stage
      of a step. A newborn has its row from its second step on.
    Raises: ValueError, if neighbours are none, or a number is negative.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> near = jeuler.Neighbours(cutoff=1.0, skin=0.2, capacity=4)
      >>> water = jeuler.Fluid(near, mass=1.0, density=0.5, stiffness=1.0, viscosity=0.0)
      >>> state = jeuler.ParticleState([[0.0], [0.5]], jnp.zeros((2, 1)))
      >>> end = jeuler.simulate(jeuler.Scene((water,), (near,)), state, dt=0.1, num_steps=1).y
      >>> bool(end.velocity[-1, 0, 0] < 0), bool(jnp.sum(end.velocity[-1]) == 0)  # pushed apart
      (True, True)

    Source: M. Mueller, D. Charypar, M. Gross, Particle-Based Fluid Simulation for Interactive Applications, SCA 2003;
      J. J. Monaghan, Rep. Prog. Phys. 68, 2005, eq. 3.3.
    """

    neighbours: Any
    mass: Parameter
    density: Parameter
    stiffness: Parameter
    viscosity: Parameter
    alive: Any = None

    limits: ClassVar[dict[str, Any]] = {
        "mass": ("> 0", "kg"), "density": (">= 0", "kg/m^dim"), "stiffness": (">= 0", "m^2/s^2"),
        "viscosity": (">= 0", "Pa s"),
    }  # fmt: skip
    axes: ClassVar[dict[str, int]] = {"mass": 0, "density": 0, "stiffness": 0, "viscosity": 0}

    def __post_init__(self) -> None:
        self._store("mass", "density", "stiffness", "viscosity")

    def densities(self, position: Array, neighbours: Array) -> Array:
        """rho of each particle, (particle,), kg/m^dim."""
        return self._densities(self._pairs(position, neighbours, None), position)

    def _densities(self, pairs: Pairs, position: Array) -> Array:
        reach, dim = self.neighbours.cutoff.astype(position.dtype), position.shape[1]
        kernel = jnp.where(pairs.here, (1 - (pairs.r / reach) ** 2) ** 3, 0)
        return self.mass.astype(position.dtype) * (1 + jnp.sum(kernel, axis=1)) * KERNEL[dim] / reach**dim

    def _shares(self, pairs: Pairs, position: Array, v: Sequence[Array], mass: Array) -> list[Array]:
        dtype, dim = position.dtype, position.shape[1]
        m, rest, stiffness, viscosity = (
            x.astype(dtype) for x in (self.mass, self.density, self.stiffness, self.viscosity)
        )
        reach = self.neighbours.cutoff.astype(dtype)
        rho = self._densities(pairs, position)
        pressure = stiffness * jnp.maximum(rho - rest, 0) / rho**2
        (pressure_j, rho_j) = pairs.of([pressure, rho])
        falls = 6 * KERNEL[dim] / reach ** (dim + 2) * (1 - (pairs.r / reach) ** 2) ** 2  # -W'(r) / r
        push = m**2 * falls * (pressure[:, None] + pressure_j)
        drag = 2 * m**2 * viscosity * falls / (rho[:, None] * rho_j)
        return [push * d + drag * (vj - vi[:, None]) for d, vi, vj in zip(pairs.d, v, pairs.of(v), strict=True)]


KERNEL = {1: 35 / 32, 2: 4 / np.pi, 3: 315 / (64 * np.pi)}  # 1 / integral of (1 - r^2)^3 over the unit ball
