"""A run as a dataset of xarray, with the names of its axes."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

OF_A_PARTICLE = {"position": "dim", "velocity": "dim", "force": "dim", "color": "channel"}  # what the last axis counts


def to_dataset(solution: Any) -> Any:
    """The ``xarray.Dataset`` of a run, see ``Solution.to_xarray``."""
    import xarray

    t = np.asarray(solution.t)
    if t.ndim != 1:
        raise ValueError(f"to_xarray needs one run, got times of shape {t.shape}; take one member of a batch")
    named = {name: np.asarray(value) for name, value in _named(solution.y).items()}
    particles = np.shape(named["position"])[1] if hasattr(solution.y, "fields") else None
    variables = {name: (_axes(name, value.shape, particles), value) for name, value in named.items()}
    counts = {name: int(getattr(solution, name)) for name in ("first_nonfinite", "unresolved_contacts")}
    return xarray.Dataset(variables, {"time": ("time", t, {"units": "s"})}, counts)


def _named(y: Any) -> dict[str, Any]:
    """The arrays of what was saved, by name: fields of a state, or paths in a pytree, "y" where it is one array."""
    if hasattr(y, "fields"):
        return {name: getattr(y, name) for name in y.fields()}
    leaves, _ = jax.tree_util.tree_flatten_with_path(y)
    return {jax.tree_util.keystr(path, simple=True, separator="_") or "y": leaf for path, leaf in leaves}


def _axes(name: str, shape: tuple[int, ...], particles: int | None) -> tuple[str, ...]:
    """The names of a variable's axes: time, particle, and what the last one counts, else one of its own."""
    own = [f"{name}_{k}" for k in range(1, len(shape))]
    if particles is not None and shape[1:2] == (particles,):
        own[0] = "particle"
        if name in OF_A_PARTICLE:
            own[-1] = OF_A_PARTICLE[name]
    return ("time", *own)
