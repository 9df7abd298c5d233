"""Who is near whom: rows of neighbours, made again when a particle has moved."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jeuler._core import checks
from jeuler._core.annotations import OptionalParameter, Parameter, default
from jeuler._core.calls import previous_is_optional
from jeuler._core.component import component, store_as_float
from jeuler._core.limits import check_limits
from jeuler._jax.anywhere import anywhere
from jeuler.graphs.cells import NOT_BUILT, nearest_image, rows_of_neighbours
from jeuler.particles.fields import START
from jeuler.particles.state import FieldForm


@component(static=("capacity", "cell_capacity"), parameters=())
class Neighbours:
    """Pairs within a cutoff, for forces between particles that see each other, such as `SoftRepulsion`.

        j is in the row of i where |p_i - p_j| < cutoff + skin; rows are made again when a particle has moved skin / 2

    The state holds the rows, ``neighbours`` (particle, capacity), -1 for none, and counts in ``missed_neighbours``
    those that found no place, in a row or in a cell, over all ends of steps at which rows were made: 0 where nothing
    was missed. Where a force is read of positions that are farther than skin / 2 from those of the rows, as at a stage
    within a long step, it makes rows of its own there; if one of these finds no place for all, the force is NaN. Which
    pairs are near has no derivative; forces that are 0 at the cutoff have the right one. Under ``jax.vmap`` rows are
    made again in all members where one member needs it.

    Args:
      cutoff: (), m, the distance up to which forces act.
      skin: (), m, how far beyond that rows reach: more makes rows longer, and seldom made.
      capacity: the most neighbours of a particle, within cutoff + skin, an integer. Static.
      cell_capacity: the most particles in a cell of side cutoff + skin; None takes capacity / 2 + 4. Static.
      box: (dim,), m, the sides of periodic space, each at least 3 (cutoff + skin); None for free space.
    Returns: called as an effect ``(t, dt, previous, state, key)``, the state with its rows.
    Raises: ValueError, if a number is not above 0, or a capacity no integer; in `simulate`, if the box is too small.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> near = jeuler.Neighbours(cutoff=1.0, skin=0.2, capacity=4)
      >>> state = jeuler.ParticleState([[0.0, 0.0], [1.1, 0.0], [3.0, 0.0]], jnp.zeros((3, 2)))
      >>> end = jeuler.simulate(jeuler.Scene(effects=(near,)), state, dt=0.1, num_steps=1).y
      >>> end.neighbours[-1].tolist(), end.missed_neighbours[-1].item()
      ([[-1, 1, -1, -1], [0, -1, -1, -1], [-1, -1, -1, -1]], 0)

    Source: L. Verlet, Computer Experiments on Classical Fluids I, Phys. Rev. 159, 1967 (rows and skin); M. P. Allen,
      D. J. Tildesley, Computer Simulation of Liquids, 2017, sect. 5.3.
    """

    cutoff: Parameter
    skin: Parameter
    capacity: int
    cell_capacity: int | None = None
    box: OptionalParameter = default(None)

    acts = START
    needs: ClassVar[tuple[str, ...]] = ()
    limits: ClassVar[dict[str, Any]] = {"cutoff": ("> 0", "m"), "skin": ("> 0", "m"), "box": ("> 0", "m")}
    axes: ClassVar[dict[str, int]] = {"cutoff": 0, "skin": 0}

    def __post_init__(self) -> None:
        store_as_float(self, "cutoff", "skin", "box")
        object.__setattr__(self, "capacity", checks.count("Neighbours.capacity", self.capacity, least=1))
        cell = self.capacity // 2 + 4 if self.cell_capacity is None else self.cell_capacity
        object.__setattr__(self, "cell_capacity", checks.count("Neighbours.cell_capacity", cell, least=1))
        check_limits(self)

    @property
    def writes(self) -> dict[str, Any]:
        return {
            "neighbours": FieldForm((self.capacity,), NOT_BUILT),
            "neighbours_made_at": FieldForm(("dim",), 0.0),
            "has_neighbours": FieldForm((), False),
            "missed_neighbours": FieldForm((), 0, whole=True),
        }

    @previous_is_optional
    def __call__(self, t: Any, dt: Any, previous: Any, state: Any, key: Any) -> Any:
        x = state.position
        alive = jnp.ones(len(x), bool) if state.alive is None else state.alive
        is_old = self._has_moved(x, state.neighbours_made_at, alive) | jnp.any(alive & ~state.has_neighbours)

        def make(before):
            rows, missed = self._made(x, state.alive)
            return rows, lax.stop_gradient(x), alive, before[3] + missed

        names = "neighbours", "neighbours_made_at", "has_neighbours", "missed_neighbours"
        made = _where(is_old, make, tuple(getattr(state, name) for name in names))
        return state.replace(**dict(zip(names, made, strict=True)))

    def rows_at(self, x: Array, rows: Array, made_at: Array, has: Array, alive: Array | None) -> Array:
        """The rows for these positions: those made at others, or new ones where a particle is too far from there.

        Those of `NOT_BUILT` where new ones cannot hold all.
        """
        is_old = self._has_moved(x, made_at, has if alive is None else has & alive)

        def make(_):
            rows, missed = self._made(x, alive)
            return jnp.where(missed > 0, NOT_BUILT, rows)

        return _where(is_old, make, rows)

    def _has_moved(self, x: Array, made_at: Array, which: Array) -> Array:
        """Whether one of these particles is farther than skin / 2 from where the rows were made."""
        x, (box, _, skin) = lax.stop_gradient(x), self._sizes(x.dtype)
        moved = jnp.sum(nearest_image(x - lax.stop_gradient(made_at), box) ** 2, axis=1)
        return jnp.any(which & (moved > (skin / 2) ** 2))

    def _made(self, x: Array, alive: Array | None) -> tuple[Array, Array]:
        box, reach, _ = self._sizes(x.dtype)
        return rows_of_neighbours(lax.stop_gradient(x), alive, reach, self.capacity, int(self.cell_capacity or 1), box)

    def _sizes(self, dtype: Any) -> tuple[Any, Array, Array]:
        """The box, cutoff + skin, and the skin."""
        return lax.stop_gradient(
            (
                None if self.box is None else self.box.astype(dtype),
                (self.cutoff + self.skin).astype(dtype),
                self.skin.astype(dtype),
            )
        )

    def check(self, particles: int, dim: int) -> None:
        if dim > 3:
            raise ValueError(f"Neighbours must be in 1, 2 or 3 dimensions, got {dim}")
        if self.box is None:
            return
        checks.shape("Neighbours.box", self.box.shape, (dim,), meaning="one side a dimension")
        if not any(map(checks.is_traced, (self.box, self.cutoff, self.skin))):
            least = 3 * (float(self.cutoff) + float(self.skin))
            if np.asarray(self.box).min() < least * (1 - 1e-6):
                raise ValueError(
                    f"Neighbours.box must be at least 3 (cutoff + skin) = {least:g} m long on each side, "
                    f"got {np.asarray(self.box).tolist()}; take a smaller cutoff or skin"
                )


def _where(needed: Array, make: Callable[[Any], Any], before: Any) -> Any:
    """make(before) where needed, (), else what was before; in a batch nothing is made where no member needs it."""

    def made(before):
        return jax.tree.map(lambda new, old: jnp.where(needed, new, old), make(before), before)

    return lax.cond(anywhere(needed), made, lambda before: before, before)
