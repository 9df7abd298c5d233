"""The parameters of a scene and its state by name: "ks", "forces[1].ks", "velocity", "anchors"."""

from __future__ import annotations

import dataclasses
import re
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jeuler._core.component import Partitioned, replace
from jeuler.particles.scene import Scene
from jeuler.particles.state import ParticleState

STATE_PARAMETERS = ("mass", "velocity", "position", "anchors")


def _free(state: ParticleState) -> np.ndarray:
    """Which particles can move."""
    return np.broadcast_to(np.isfinite(np.asarray(state.mass)), state.position.shape[:1])


def _fields(force: Any) -> set[str]:
    """The names of a force's parameters."""
    force = force.whole() if isinstance(force, Partitioned) else force
    if not dataclasses.is_dataclass(force):
        return set()
    return {field.name for field in dataclasses.fields(force)} - {"edges", "function"}


def _owners(scene: Scene, name: str) -> tuple[list[int], str]:
    """Which forces have the parameter "ks", or "forces[1].ks" for one of them, and its field's name."""
    one = re.fullmatch(r"forces\[(\d+)\]\.(\w+)", name)
    field = one.group(2) if one else name
    owners = [k for k, force in enumerate(scene.forces) if field in _fields(force)]
    return [k for k in owners if one is None or k == int(one.group(1))], field


def values_in_forces(scene: Scene, name: str) -> Any:
    """What the one force that has this parameter has there; a tuple where several have it."""
    owners, field = _owners(scene, name)
    values = tuple(getattr(scene.forces[k], field) for k in owners)
    return values[0] if len(values) == 1 else values


def is_positive(name: str) -> bool:
    """Whether a parameter of this name is fitted as a logarithm."""
    return name.rpartition(".")[2] not in ("velocity", "position", "anchors", "acceleration")


def read_parameters(scene: Scene, state: ParticleState, parameters: tuple[str, ...]) -> dict[str, Any]:
    """The starting values by name."""
    if isinstance(parameters, str) or not parameters:
        raise ValueError(f'parameters must be a tuple of names such as ("ks", "kd"), got {parameters!r}')
    free, dtype = _free(state), state.position.dtype
    start: dict[str, Any] = {}
    for name in parameters:
        if _owners(scene, name)[0]:
            start[name] = jax.tree.map(lambda x: jnp.asarray(x, dtype), values_in_forces(scene, name))
        elif name not in STATE_PARAMETERS:
            known = sorted(set().union(*(_fields(force) for force in scene.forces)))
            raise ValueError(f"parameters must be among {(*known, *STATE_PARAMETERS)} for this scene, got {name!r}")
        elif name == "mass" and not state.mass.ndim:
            start[name] = state.mass
        else:
            rows = np.flatnonzero(~free if name == "anchors" else free)
            if not rows.size:
                kind = "pinned (mass = inf)" if name == "anchors" else "free"
                raise ValueError(f"parameters names {name!r}, but the state has no {kind} particle")
            start[name] = getattr(state, "position" if name == "anchors" else name)[rows]
    return start


def put_parameters(scene: Scene, state: ParticleState, params: dict[str, Any]) -> tuple[Scene, ParticleState]:
    """Scene and state with the parameters put in."""
    free = _free(state)
    forces = list(scene.forces)
    for name, value in params.items():
        owners, field = _owners(scene, name)
        for k, x in zip(owners, value if len(owners) > 1 else (value,), strict=False):
            forces[k] = replace(forces[k], **{field: x})
        if not owners and name == "mass" and not value.ndim:
            state = replace(state, mass=value)
        elif not owners:
            field = "position" if name == "anchors" else name
            rows = np.flatnonzero(~free if name == "anchors" else free)
            state = replace(state, **{field: getattr(state, field).at[rows].set(value)})
    return replace(scene, forces=tuple(forces)), state
