"""Springs and their kin as a run calls them: parameters in the slots of the layouts."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from jeuler._core import checks
from jeuler._core.component import component, replace
from jeuler._core.components import split, stack
from jeuler.graphs.layouts import Layout
from jeuler.graphs.topology import Topology

STRENGTHS = ("ks", "kd", "cubic")  # what a link without one of its ends has not


@component(static=("edges", "layouts", "law", "names", "read_again"))
class PreparedLinks:
    """Links as the kernels take them, with the parameters in the slots of each layout."""

    edges: Topology
    layouts: tuple[Layout, ...]
    law: Callable[..., Array]
    names: tuple[str, ...]
    read_again: bool  # see `Layout.central_force`
    parameters: Any  # of each name, what `Layout.to_slots` made of it
    box: Array | None = None  # (dim,), m, the sides of periodic space

    def __call__(self, t: Any, position: Array, velocity: Array, mass: Array, broken: Array | None = None) -> Array:
        if broken is not None:
            checks.shape("state.broken", broken.shape, (1, len(self.edges)), meaning="one a spring; see Breaking")
            return self.only(~broken[0])(t, position, velocity, mass)
        x, v = split(position), split(velocity)
        box = None if self.box is None else list(self.box)
        total = [jnp.zeros_like(component) for component in x]
        for layout, *parameters in zip(self.layouts, *self.parameters, strict=True):
            shares = layout.central_force(self.law, x, v, parameters, self.read_again, box)
            total = [a + b for a, b in zip(total, shares, strict=True)]
        return stack(total)

    def prepare(self, context: Any) -> PreparedLinks:
        """Between the living only: a link with a dead end has no stiffness and no damping."""
        return self if context.alive is None else self.only(jnp.all(context.alive[self.edges[:]], axis=1))

    def only(self, which: Array) -> PreparedLinks:
        """These links only, (link,) boolean: the others have no stiffness and no damping."""
        here = [layout.to_slots(which) for layout in self.layouts]

        def only_here(name, parameter):
            if name not in STRENGTHS:
                return parameter
            groups = [layout.by_group(x) for layout, x in zip(self.layouts, parameter, strict=True)]
            return jax.tree.map(lambda on, x: jnp.where(on, x, 0), here, groups)

        pairs = zip(self.names, self.parameters, strict=True)
        return replace(self, parameters=[only_here(name, parameter) for name, parameter in pairs])


def in_box(box: Array | None, dtype: Any) -> Array | None:
    """The sides of periodic space as the kernels take them."""
    return None if box is None else box.astype(dtype)


def check_box(links: Any, dim: int) -> None:
    """One ValueError if the sides of periodic space are not one a dimension."""
    if links.box is not None:
        checks.shape(f"{type(links).__name__}.box", links.box.shape, (dim,), meaning="one side a dimension")
