"""Which values change with what a derivative is taken by."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

from jax import Array
from jax.interpreters import ad


@dataclasses.dataclass(frozen=True)
class Moving:
    """Values within a forward derivative, told apart by whether they have a tangent.

    Those that have none are held as they are: carried along with tangents of zeros, they would be computed with.

    Attributes:
      places: of those that have one.
      held: the others by their place, without a trace of the derivative.
    """

    places: tuple[int, ...]
    held: dict[int, Any]

    @classmethod
    def of(cls, values: Sequence[Any]) -> Moving:
        moves = [isinstance(value, ad.JVPTracer) and type(value.tangent) is not ad.Zero for value in values]
        held = {
            k: value.primal if isinstance(value, ad.JVPTracer) else value
            for k, (value, yes) in enumerate(zip(values, moves, strict=True))
            if not yes
        }
        return cls(tuple(k for k, yes in enumerate(moves) if yes), held)

    def moving(self, values: Sequence[Any]) -> list[Any]:
        """Those that move."""
        return [values[k] for k in self.places]

    def joined(self, moving: Sequence[Array]) -> list[Any]:
        """All of them, with these in the places of those that move."""
        values = self.held | dict(zip(self.places, moving, strict=True))
        return [values[k] for k in range(len(values))]
