"""Springs that break, for good, where they are stretched too far."""

from __future__ import annotations

from typing import Any, ClassVar

import jax.numpy as jnp

from jeuler._core import checks
from jeuler._core.annotations import Parameter
from jeuler._core.calls import previous_is_optional
from jeuler._core.component import component, store_as_float
from jeuler._core.limits import check_limits
from jeuler._core.vectors import direction
from jeuler.forces.links import BreakableSprings
from jeuler.forces.prepared import in_box
from jeuler.particles.fields import START
from jeuler.particles.state import FieldForm


@component(parameters=("max_strain",), positive=("max_strain",))
class Breaking:
    """What breaks `BreakableSprings`: a spring that is longer than it can be is gone from there on.

        broken <- broken or r > (1 + max_strain) L

    The state holds ``broken``, (1, spring), and how many there are, ``broken_springs``: one set of such springs a
    scene. Which springs break, and when, has no derivative.

    Args:
      springs: the `BreakableSprings` of the scene.
      max_strain: the strain at which a spring breaks, () or (spring,); 0.5 is one and a half times the rest length.
    Returns: called as an effect ``(t, dt, previous, state, key)``, the state with what broke by time t.
    Raises: ValueError, if springs are of another kind; in `simulate`, if max_strain has another shape or is negative.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> state = jeuler.ParticleState([[0.0], [2.0], [2.5]], jnp.zeros((3, 1)))
      >>> net = jeuler.BreakableSprings([[0, 1], [1, 2]], ks=1.0, kd=0.0, rest_length=1.0)
      >>> scene = jeuler.Scene((net,), (jeuler.Breaking(net, max_strain=0.5),))
      >>> jeuler.simulate(scene, state, dt=0.1, num_steps=0).y.broken[0].tolist()
      [[True, False]]
    """

    springs: BreakableSprings
    max_strain: Parameter

    acts = START
    needs: ClassVar[tuple[str, ...]] = ("forward time",)
    limits: ClassVar[dict[str, Any]] = {"max_strain": (">= 0", "")}
    may_be_infinite: ClassVar[tuple[str, ...]] = ("max_strain",)

    def __post_init__(self) -> None:
        if not isinstance(self.springs, BreakableSprings):
            raise ValueError(
                f"Breaking.springs must be BreakableSprings, got {checks.shown(self.springs)}; "
                f"write net = BreakableSprings(...), Scene((net,), (Breaking(net, max_strain=0.5),))"
            )
        store_as_float(self, "max_strain")

    @property
    def writes(self) -> dict[str, Any]:
        count = FieldForm((), 0, whole=True)
        return {"broken": FieldForm((1, len(self.springs.edges)), False, whole=True), "broken_springs": count}

    @previous_is_optional
    def __call__(self, t: Any, dt: Any, previous: Any, state: Any, key: Any) -> Any:
        edges = self.springs.edges
        r, _ = direction(edges.difference(state.position, in_box(self.springs.box, state.position.dtype)))
        too_long = r[:, 0] > (1 + self.max_strain) * self.springs.rest_length
        if state.alive is not None:
            too_long = too_long & jnp.all(state.alive[edges[:]], axis=1)
        broken = state.broken | too_long[None]
        return state.replace(broken=broken, broken_springs=jnp.sum(broken, dtype=jnp.int32))

    def check(self, particles: int, dim: int) -> None:
        self.springs.check(particles, dim)
        shape = self.max_strain.shape
        checks.shape("Breaking.max_strain", shape, (), (len(self.springs.edges),), meaning="one a spring")
        check_limits(self)
