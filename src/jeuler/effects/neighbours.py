"""Who is near whom: rows of neighbours, made again when a particle has moved."""

from __future__ import annotations

from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from jax import lax

from jeuler._core import checks
from jeuler._core.annotations import OptionalParameter, Parameter, default
from jeuler._core.calls import previous_is_optional
from jeuler._core.component import component, store_as_float
from jeuler._core.limits import check_limits
from jeuler.graphs.cells import NOT_BUILT, nearest_image, rows_of_neighbours
from jeuler.particles.fields import START
from jeuler.particles.state import FieldForm


@component(static=("capacity", "cell_capacity"), parameters=())
class Neighbours:
    """Pairs within a cutoff, for forces between particles that see each other, such as `SoftRepulsion`.

        j is in the row of i where |p_i - p_j| < cutoff + skin; rows are made again when a particle has moved skin / 2

    The state holds the rows, ``neighbours`` (particle, capacity), -1 for none, and counts in ``missed_neighbours``
    those that found no place, in a row or in a cell, over all times that rows were made: 0 where nothing was
    missed. Rows are made at the ends of steps: in a step in which a particle moves by more than skin / 2, a method
    of several stages may miss one. Which pairs are near has no derivative; forces that are 0 at the cutoff have the
    right one. Under ``jax.vmap`` rows are made at each step.

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
        dtype = state.position.dtype
        x = lax.stop_gradient(state.position)
        box = None if self.box is None else lax.stop_gradient(self.box.astype(dtype))
        reach, skin = (lax.stop_gradient(one.astype(dtype)) for one in (self.cutoff + self.skin, self.skin))
        alive = jnp.ones(len(x), bool) if state.alive is None else state.alive
        moved = jnp.sum(nearest_image(x - state.neighbours_made_at, box) ** 2, axis=1) > (skin / 2) ** 2
        is_old = jnp.any(alive & (moved | ~state.has_neighbours))

        def make(_):
            rows, missed = rows_of_neighbours(x, state.alive, reach, self.capacity, int(self.cell_capacity or 1), box)
            return rows, x, alive, state.missed_neighbours + missed

        def keep(_):
            return state.neighbours, state.neighbours_made_at, state.has_neighbours, state.missed_neighbours

        names = "neighbours", "neighbours_made_at", "has_neighbours", "missed_neighbours"
        return state.replace(**dict(zip(names, lax.cond(is_old, make, keep, None), strict=True)))

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
