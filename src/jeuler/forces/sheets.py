"""Sheets that do not pass through themselves or each other: particles against triangles."""

from __future__ import annotations

from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from jax import Array

from jeuler._core import checks
from jeuler._core.annotations import Parameter, ParticleIndices, default
from jeuler._core.component import component
from jeuler._core.indices import particle_groups
from jeuler._core.triangles import nearest_weights
from jeuler._core.vectors import direction
from jeuler.forces.nearby import _Nearby
from jeuler.graphs.cells import nearest_image


@component(static=("triangles",), parameters=("thickness", "ks", "kd"), positive=("thickness", "ks", "kd"))
class TriangleContact(_Nearby):
    """Particles that are pushed off triangles of other particles: cloth against itself, hair against cloth.

        q = sum_k w_k p_k  the point of a triangle nearest to p_i,   d = p_i - q,  r = |d|,  u = d / r
        f = ks (s - r) u - kd (s - r) / s ((v_i - sum_k w_k v_k).u) u  where r < s,   F_i = f,   F_k = -w_k f

    Each triangle belongs to one of its corners, and is seen by those that have this corner among their neighbours. A
    particle is pushed to the side on which it is: let none go further than s in a step. A triangle does not act on its
    own corners; take s below the distance of the others from it where the sheet is as it should be.

    Args:
      neighbours: the `Neighbours` of the scene, in its effects too; their cutoff is at least s and the longest side of
        the triangles, at any time.
      triangles: integers (triangle, 3), such as ``from_mesh(...).triangles``. Static.
      thickness: s, (), m. Differentiable.
      ks: (), N/m. Differentiable.
      kd: (), N s/m. Differentiable.
    Returns: called as a force ``(t, position, velocity, mass, neighbours, neighbours_made_at, has_neighbours)``,
      (particle, 3), N; it sums to zero and has no torque. NaN where the state's rows were never made, are too short at
      a stage of a step, or a side has grown longer than the cutoff less s.
    Raises: ValueError, if neighbours are none, triangles are no integers (triangle, 3) or name a particle twice, or a
      number is negative; in `simulate`, if an index is out of range or space has not three dimensions.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> near = jeuler.Neighbours(cutoff=1.6, skin=0.2, capacity=3)
      >>> sheet = jeuler.TriangleContact(near, [[0, 1, 2]], thickness=0.1, ks=100.0)
      >>> state = jeuler.ParticleState([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0.2, 0.2, 0.05]], jnp.zeros((4, 3)))
      >>> run = jeuler.simulate(jeuler.Scene((sheet,), (near,)), state, dt=0.01, num_steps=1).y
      >>> [round(v, 3) for v in run.velocity[-1, :, 2].tolist()]
      [-0.03, -0.01, -0.01, 0.05]

    Source: R. Bridson, R. Fedkiw, J. Anderson, Robust Treatment of Collisions, Contact and Friction for Cloth
      Animation, SIGGRAPH 2002, sect. 4 and 7 (weights of the corners, repulsion).
    """

    neighbours: Any
    triangles: ParticleIndices
    thickness: Parameter
    ks: Parameter
    kd: Parameter = default(0.0)
    alive: Any = None

    limits: ClassVar[dict[str, Any]] = {"thickness": ("> 0", "m"), "ks": (">= 0", "N/m"), "kd": (">= 0", "N s/m")}
    axes: ClassVar[dict[str, int]] = {"thickness": 0, "ks": 0, "kd": 0}

    def __post_init__(self) -> None:
        triangles = particle_groups("TriangleContact.triangles", self.triangles, 3, "triangle", "its three corners")
        object.__setattr__(self, "triangles", triangles)
        self._store("thickness", "ks", "kd")

    def _total(self, rows: Array, made: Array | None, position: Array, velocity: Array, mass: Array) -> Array:
        triangles = np.asarray(self.triangles)
        seen, here = self._seen(rows, triangles, made)
        corners = jnp.asarray(triangles)[seen]  # (particle, place, 3)
        s, ks, kd = (x.astype(position.dtype) for x in (self.thickness, self.ks, self.kd))
        w = nearest_weights(position[:, None], self._near(position[:, None], position[corners]))
        there = jnp.sum(w[..., None] * self._near(position[:, None], position[corners]), axis=2)
        r, u = direction(position[:, None] - there)
        approach = jnp.sum((velocity[:, None] - jnp.sum(w[..., None] * velocity[corners], axis=2)) * u, axis=-1)
        size = jnp.where(here, jnp.maximum(s - r[..., 0], 0) * (ks - kd / s * approach), 0)
        push = size[..., None] * u
        total = jnp.sum(push, axis=1).at[corners].add(-w[..., None] * push[..., None, :])
        return jnp.where(self._longest(position, triangles) + s > self.neighbours.cutoff, jnp.nan, total)

    def _seen(self, rows: Array, triangles: np.ndarray, made: Array | None) -> tuple[Array, Array]:
        """The triangles of the neighbours of each particle, (particle, place), and whether there is one that acts."""
        particles = len(rows)
        owned = owners(triangles, particles)
        who = jnp.where((rows >= 0) & (rows < particles), rows, particles)
        seen = jnp.asarray(owned)[who].reshape(particles, -1)
        here, seen = seen >= 0, jnp.maximum(seen, 0)
        corners = jnp.asarray(triangles)[seen]
        here = here & jnp.all(corners != jnp.arange(particles)[:, None, None], axis=2)
        if self.alive is not None:
            live = self.alive if made is None else self.alive & made
            here = here & live[:, None] & jnp.all(live[corners], axis=2)
        return seen, here

    def _near(self, p: Array, corners: Array) -> Array:
        """The corners (particle, place, 3, dim) at their images nearest to p."""
        box = self.neighbours.box
        if box is None:
            return corners
        p = p[..., None, :]
        return p - nearest_image(p - corners, box.astype(p.dtype))

    def _longest(self, position: Array, triangles: np.ndarray) -> Array:
        sides = position[triangles] - position[np.roll(triangles, 1, axis=1)]
        box = self.neighbours.box
        sides = nearest_image(sides, None if box is None else box.astype(position.dtype))
        square = jnp.sum(sides * sides, axis=-1)
        if self.alive is not None:
            square = jnp.where(jnp.all(self.alive[triangles], axis=1)[:, None], square, 0)
        return jnp.sqrt(jnp.max(square, initial=0))

    def check(self, particles: int, dim: int) -> None:
        if dim != 3:
            raise ValueError(
                f"TriangleContact must be in space, dim = 3, got dim = {dim}; in the plane use SoftRepulsion"
            )
        self.neighbours.check(particles, dim)
        checks.indices("TriangleContact.triangles", self.triangles, particles, "particle indices")


def owners(triangles: np.ndarray, particles: int) -> np.ndarray:
    """The triangles that each particle owns, (particle + 1, most), -1 for none: of its corners the one with fewest."""
    owned: list[list[int]] = [[] for _ in range(particles + 1)]
    for number, corners in enumerate(triangles.tolist()):
        owned[min(corners, key=lambda k: len(owned[k]))].append(number)
    most = max(1, max(map(len, owned)))
    return np.array([row + [-1] * (most - len(row)) for row in owned], np.int32)
