"""The parameters of a scene and its state by name: "ks", "forces[1].ks", "restitution", "velocity", "anchors"."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jeuler._core import checks
from jeuler._core.component import parameters_of, replace
from jeuler.fitting.ties import Tie, checked_ties
from jeuler.forces.springs import Springs
from jeuler.particles.scene import Scene
from jeuler.particles.state import ParticleState

STATE_PARAMETERS = ("mass", "velocity", "position", "anchors")
WHERE = "where"  # the name of what a function of the scene picks
MOST = {"restitution": 1.0}  # what no fit may exceed, by its meaning


def parts_of(scene: Scene) -> tuple[Any, ...]:
    """What a name of the scene may speak of: its forces, then its effects."""
    return (*scene.forces, *scene.effects)


def owners_of(scene: Scene, name: str) -> tuple[list[int], str]:
    """Which of `parts_of` a name speaks of, and its field: "ks" of the springs first, then of forces, then of effects.

    "forces[1].ks" and "effects[0].restitution" speak of one.
    """
    one = re.fullmatch(r"(forces|effects)\[(\d+)\]\.(\w+)", name)
    field = one.group(3) if one else name
    owners = [k for k, part in enumerate(parts_of(scene)) if field in parameters_of(part)]
    if one is not None:
        number = int(one.group(2)) + (len(scene.forces) if one.group(1) == "effects" else 0)
        within = one.group(1) == "effects" or number < len(scene.forces)
        return [k for k in owners if k == number and within], field
    forces = [k for k in owners if k < len(scene.forces)]
    springs = [k for k in forces if isinstance(scene.forces[k], Springs)]
    return springs or forces or owners, field


def _spoken(scene: Scene, owner: int) -> str:
    """The name of one of `parts_of`."""
    count = len(scene.forces)
    return f"forces[{owner}]" if owner < count else f"effects[{owner - count}]"


def values_of_springs(scene: Scene, field: str) -> Any:
    """What all springs of a scene have there: as it is of one `Springs`, of several one array, one value a spring."""
    springs = [force for force in scene.forces if isinstance(force, Springs)]
    if len(springs) == 1:
        return getattr(springs[0], field)
    parts = [jnp.broadcast_to(getattr(force, field), (len(force.edges),)) for force in springs]
    return jnp.concatenate(parts) if parts else jnp.zeros(0)


@dataclasses.dataclass(frozen=True)
class Places:
    """Which particles are free and which pinned, and what is fitted: hashable, a part of the program."""

    names: tuple[str, ...]
    free: tuple[int, ...]
    pinned: tuple[int, ...]
    where: Callable[[Scene], Any] | None = None
    ties: tuple[Tie, ...] = ()

    @classmethod
    def of(
        cls,
        state: ParticleState,
        names: Any,
        where: Callable[[Scene], Any] | None,
        ties: Any = None,
        scene: Scene | None = None,
        least: int = 1,
    ) -> Places:
        """The places of these names, at least so many, or one ValueError; ties need the scene."""
        if isinstance(names, str) or not (names or where is not None or not least):
            raise ValueError(f'parameters must be a tuple of names such as ("ks", "kd"), got {names!r}')
        names = tuple(names)
        for name in names:
            if not isinstance(name, str):
                raise ValueError(f'parameters must be a tuple of names such as ("ks", "kd"), got {name!r} in it')
            if names.count(name) > 1:
                raise ValueError(f"parameters must name each parameter once, got {name!r} {names.count(name)} times")
        can_move = np.broadcast_to(np.isfinite(np.asarray(state.mass)), state.position.shape[:1])
        free, pinned = (tuple(np.flatnonzero(mask).tolist()) for mask in (can_move, ~can_move))
        untied = cls(names, free, pinned, where)
        if ties is None or scene is None:
            return untied
        return dataclasses.replace(untied, ties=checked_ties(ties, names, untied.read(scene, state)))

    @property
    def untied(self) -> Places:
        """The same with every number an unknown of its own."""
        return dataclasses.replace(self, ties=())

    def reduced(self, params: dict[str, Any]) -> dict[str, Any]:
        """Parameters of `untied` with one number for those that are tied."""
        return {**params, **{tie.name: tie.reduced(params[tie.name]) for tie in self.ties}}

    def expanded(self, params: dict[str, Any]) -> dict[str, Any]:
        """Parameters as `untied` has them."""
        return {**params, **{tie.name: tie.expanded(params[tie.name]) for tie in self.ties}}

    def rows(self, name: str) -> np.ndarray:
        """The particles whose values a name of the state speaks of."""
        return np.asarray(self.pinned if name == "anchors" else self.free, int)

    def read(self, scene: Scene, state: ParticleState) -> dict[str, Any]:
        """The starting values by name."""
        start: dict[str, Any] = {}
        for name in self.names:
            owners, field = owners_of(scene, name)
            if owners:
                parts = parts_of(scene)
                values = tuple(jnp.asarray(getattr(parts[k], field), state.position.dtype) for k in owners)
                start[name] = values if len(values) > 1 else values[0]
            elif name not in STATE_PARAMETERS:
                raise ValueError(
                    f"parameters must be among {tuple(_known(scene))} for this scene, got {name!r}; "
                    f"forces[1].ks names that of one force, and where= a function of the scene anything else"
                )
            elif name == "mass" and not state.mass.ndim:
                start[name] = state.mass
            else:
                rows = self.rows(name)
                if not rows.size:
                    kind = "pinned (mass = inf)" if name == "anchors" else "free"
                    raise ValueError(f"parameters names {name!r}, but the state has no {kind} particle")
                values = getattr(state, "position" if name == "anchors" else name)
                start[name] = values[rows] if checks.is_traced(values) else np.asarray(values)[rows]
        if self.where is not None:
            start[WHERE] = self._picked(scene)
        self._refuse_twice(scene)
        return self.reduced(start)

    def _picked(self, scene: Scene) -> Any:
        """What the function of the scene picks."""
        try:
            picked = self.where(scene)  # type: ignore[misc]  # not None: read asks
        except (AttributeError, IndexError, TypeError) as error:
            raise ValueError(
                f"where must be a function of the scene, such as lambda scene: scene.forces[1].ks; it fails: {error}"
            ) from None
        if not jax.tree.leaves(picked):
            raise ValueError("where must pick arrays of the scene, such as scene.forces[1].ks, got nothing")
        return picked

    def _refuse_twice(self, scene: Scene) -> None:
        """No value may have two names: "ks" and "forces[0].ks"."""
        seen: dict[tuple[int, str], str] = {}
        for name in self.names:
            owners, field = owners_of(scene, name)
            for owner in owners:
                if (owner, field) in seen:
                    raise ValueError(
                        f"parameters names {_spoken(scene, owner)}.{field} twice, as {seen[owner, field]!r} and "
                        f"{name!r}; leave one out"
                    )
                seen[owner, field] = name

    def put(self, scene: Scene, state: ParticleState, params: dict[str, Any]) -> tuple[Scene, ParticleState]:
        """Scene and state with the parameters put in."""
        params = self.expanded(params)
        if self.where is not None:
            import equinox

            scene = equinox.tree_at(self.where, scene, params[WHERE])
        parts = list(parts_of(scene))
        for name in self.names:
            value = params[name]
            owners, field = owners_of(scene, name)
            for k, x in zip(owners, value if len(owners) > 1 else (value,), strict=False):
                parts[k] = replace(parts[k], **{field: x})
            if not owners and name == "mass" and not value.ndim:
                state = replace(state, mass=value)
            elif not owners:
                field = "position" if name == "anchors" else name
                state = replace(state, **{field: getattr(state, field).at[self.rows(name)].set(value)})
        count = len(scene.forces)
        return replace(scene, forces=tuple(parts[:count]), effects=tuple(parts[count:])), state

    def positive(self, scene: Scene) -> dict[str, bool]:
        """Which of the parameters must not be negative."""
        found = {}
        for name in self.names:
            owners, field = owners_of(scene, name)
            found[name] = name == "mass" or (bool(owners) and parameters_of(parts_of(scene)[owners[0]])[field])
        return found | ({WHERE: False} if self.where is not None else {})

    def bounds(self, scene: Scene, given: Any) -> Any:
        """The bounds that the user gave, within those that follow from the meaning of a parameter."""
        if given is not None and not isinstance(given, dict):
            return given
        fields = {name: owners_of(scene, name) for name in self.names}
        found = dict(given or {})
        for name, (owners, field) in fields.items():
            pair = found.get(name, (None, None))
            if owners and field in MOST and isinstance(pair, (tuple, list)) and len(pair) == 2:
                most = MOST[field] if pair[1] is None else np.minimum(pair[1], MOST[field])
                found[name] = (pair[0], most)
        return found or None


def _known(scene: Scene) -> list[str]:
    """The names that a scene offers."""
    plain = sorted(set().union(*(parameters_of(part) for part in parts_of(scene))))
    return [*plain, *STATE_PARAMETERS]
