"""Indices of particles, constant while tracing."""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np

from jeuler._core import checks


class Indices:
    """Particle indices, fixed while tracing: hashable and equal by content, read as an integer array."""

    def __init__(self, indices: Any, name: str = "indices", meaning: str = "integers, particle indices") -> None:
        self.indices: np.ndarray = np.array(checks.integers(name, indices, meaning))
        self.indices.setflags(write=False)
        self._key = (self.indices.shape, hashlib.sha1(self.indices.tobytes()).hexdigest())

    def __hash__(self) -> int:
        return hash(self._key)

    def __eq__(self, other: object) -> bool:
        return type(other) is type(self) and self._key == other._key

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return np.array(self.indices, dtype=dtype)

    def __getitem__(self, index: Any) -> np.ndarray:
        return self.indices[index]

    def __len__(self) -> int:
        return len(self.indices)

    @property
    def shape(self) -> tuple[int, ...]:
        return self.indices.shape

    def __repr__(self) -> str:
        return f"{type(self).__name__}(shape={self.shape})"


def different_particles(name: str, given: Any) -> Indices:
    """The indices of different particles, (particle,), from a list, an array or a range."""
    indices = Indices(list(given) if isinstance(given, range) else given, name)
    if len(indices.shape) != 1:
        raise ValueError(f"{name} must have shape (particle,), got {indices.shape}")
    checks.different(name, indices.indices, "particles")
    return indices


def particle_groups(name: str, given: Any, count: int, group: str, meaning: str) -> Indices:
    """The indices of groups of different particles, so many in each, (group, count)."""
    indices = Indices(given, name, f"integers of shape ({group}, {count}), particle indices")
    if len(indices.shape) != 2 or indices.shape[1] != count:
        raise ValueError(f"{name} must be integers of shape ({group}, {count}), got {indices.shape}")
    checks.different(name, indices.indices, f"particles, {meaning}")
    return indices
