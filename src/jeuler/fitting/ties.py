"""Parameters that are tied: all left springs alike, all right ones alike."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import jax.numpy as jnp
import numpy as np

from jeuler._core import checks


@dataclasses.dataclass(frozen=True)
class Tie:
    """The numbers of a parameter in groups, each of which is one unknown. Hashable, a part of the program.

    Attributes:
      name: of the parameter.
      groups: the group of each number, in order of the first appearance, (number,).
      shapes: of the arrays that hold the numbers, one for each force.
    """

    name: str
    groups: tuple[int, ...]
    shapes: tuple[tuple[int, ...], ...]

    @classmethod
    def of(cls, name: str, labels: Any, values: tuple[Any, ...]) -> Tie:
        """From one label for each number, or one ValueError."""
        shapes = tuple(np.shape(value) for value in values)
        count = sum(map(math.prod, shapes))
        given = list(np.ravel(np.asarray(labels, object))) if not isinstance(labels, str) else [labels]
        if len(given) != count or count < 2:
            hint = "; it is one number for all already" if count < 2 else ""
            raise ValueError(
                f"ties[{name!r}] must have one label for each of the {count} numbers of {name!r}, those with the same "
                f"label being one unknown, got {len(given)} labels{hint}"
            )
        known: dict[Any, int] = {}
        try:
            groups = tuple(known.setdefault(label, len(known)) for label in given)
        except TypeError:
            raise ValueError(f"ties[{name!r}] must be labels such as numbers or words, got {labels!r}") from None
        return cls(name, groups, shapes)

    def reduced(self, values: Any) -> Any:
        """One number a group: the mean of those in it, of an array or a tuple of arrays, one a force."""
        parts = values if isinstance(values, tuple) else (values,)
        xp: Any = jnp if any(map(checks.is_traced, parts)) else np
        flat = xp.concatenate([xp.ravel(xp.asarray(x)) for x in parts])
        share = np.eye(max(self.groups) + 1)[:, np.asarray(self.groups)]
        return xp.asarray((share / share.sum(axis=1, keepdims=True)).astype(flat.dtype) @ flat)

    def expanded(self, x: Any) -> Any:
        """The arrays that hold the numbers."""
        flat, parts, first = jnp.asarray(x)[np.asarray(self.groups)], [], 0
        for shape in self.shapes:
            parts.append(flat[first : first + math.prod(shape)].reshape(shape))
            first += math.prod(shape)
        return tuple(parts) if len(parts) > 1 else parts[0]


def checked_ties(ties: Any, names: tuple[str, ...], values: dict[str, Any]) -> tuple[Tie, ...]:
    """From ``{name: labels}``, or one ValueError."""
    if ties is None:
        return ()
    if not isinstance(ties, dict) or not ties:
        raise ValueError(f"ties must be a dict {{name: labels}}, got {checks.shown(ties)}")
    for name in ties:
        if name not in names:
            raise ValueError(f"ties must name parameters, {names}, got {name!r}")
    return tuple(
        Tie.of(name, labels, values[name] if isinstance(values[name], tuple) else (values[name],))
        for name, labels in ties.items()
    )
