"""Which fields of the state a force or an effect reads and writes: the state is built from their union."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, Literal, TypeVar

from jeuler._core import checks
from jeuler._core.arguments import says_what_to_write
from jeuler._core.component import unwrapped
from jeuler.particles.state import ParticleState, with_default_fields

F = TypeVar("F", bound=Callable)

BEFORE, AFTER, START = ACTS = ("before motion", "after motion", "start and after motion")
Acts = Literal["before motion", "after motion", "start and after motion"]
Need = Literal["key", "clock", "forward time", "prescribed pinned", "the solve", "the events", "the last place"]


@says_what_to_write()
def uses(
    *,
    reads: tuple[str, ...] = (),
    writes: tuple[str, ...] = (),
    sets: tuple[str, ...] = (),
    before_motion: bool = False,
    acts: Acts | None = None,
) -> Callable[[F], F]:
    """Declare the fields of a force or effect that is a plain function. Position, velocity and mass need no word.

    A force gets the fields that it reads as keywords after its four arguments; an effect finds them in the state.

    Args:
      reads: fields that must be there.
      writes: fields that an effect changes for some particles; the state gets them if it has none.
      sets: fields that an effect gives to every particle, each step: nothing else may write them.
      before_motion: True for births and deaths, which come before the motion of a step; as acts="before motion".
      acts: when an effect acts: "before motion", "after motion", as without a word, or "start and after motion", once
        before the first step as well.
    Returns: a decorator that gives the function back, with these as its attributes.
    Raises: ValueError, if acts is none of these; in `simulate`, if nothing provides a field that is read, or
      two effects write one in conflict.
    Example:
      >>> import jeuler
      >>> @jeuler.uses(reads=("temperature",))
      ... def buoyancy(t, position, velocity, mass, temperature):
      ...     return (temperature / 300.0 - 1.0)[:, None] * position.at[:].set([0.0, 9.81])
      >>> buoyancy.reads
      ('temperature',)
    """

    if acts not in (None, *ACTS):
        raise ValueError(f"acts must be one of {', '.join(map(repr, ACTS))}, got {acts!r}")

    for what, names in (("reads", reads), ("writes", writes), ("sets", sets)):
        if isinstance(names, str) or not isinstance(names, (tuple, list)) or any(not isinstance(n, str) for n in names):
            raise ValueError(
                f"uses.{what} must be a tuple of names of fields, got {checks.shown(names)}; "
                f'write {what}=("temperature",)'
            )
    checks.true_or_false("uses.before_motion", before_motion)

    def decorate(function: F) -> F:
        when = acts or (BEFORE if before_motion else AFTER)
        values = {"reads": reads, "writes": writes, "sets": sets, "acts": when}
        for name, value in values.items():
            setattr(function, name, value)
        return function

    return decorate


def declared(part: Any, what: str, default: Any = ()) -> Any:
    """What a force or effect says of itself: the fields it ``reads``, ``writes`` or ``sets``, or another attribute."""
    return getattr(unwrapped(part), what, default)


def acts(effect: Any) -> str:
    """When in a step an effect acts, one of `ACTS`."""
    return declared(effect, "acts", BEFORE if declared(effect, "before_motion", False) else AFTER)


def needs(effect: Any, what: Need) -> bool:
    """Whether an effect needs this; ``random = True`` is an older word for a need of a key."""
    return what in declared(effect, "needs") or (what == "key" and declared(effect, "random", False))


def draws(effect: Any, key: Any) -> bool:
    """Whether an effect may draw random numbers; one that does not say what it needs does so if there is a key."""
    return needs(effect, "key") or (key is not None and declared(effect, "needs", None) is None)


def name_of(part: Any) -> str:
    part = unwrapped(part)
    return getattr(part, "__name__", type(part).__name__)


def with_required_fields(state: ParticleState, forces: Iterable[Any], effects: Iterable[Any]) -> ParticleState:
    """The state with every field that the effects write; ValueError if one is missing, in conflict, or in bad order."""
    effects = tuple(effects)
    shapes: dict[str, Any] = {}
    for effect in effects:
        for fields in (declared(effect, "writes"), declared(effect, "sets")):
            shapes |= fields if isinstance(fields, dict) else {}
        for field in declared(effect, "sets"):
            for other in effects:
                if other is not effect and field in (*declared(other, "writes"), *declared(other, "sets")):
                    raise ValueError(
                        f"{name_of(effect)} sets {field!r} of every particle at each step, and {name_of(other)} "
                        f"writes it too: one of them would be lost; take one of the two out of Scene.effects"
                    )
    _check_order(effects)
    written = [name for effect in effects for name in (*declared(effect, "writes"), *declared(effect, "sets"))]
    state = with_default_fields(state, tuple(dict.fromkeys(written)), shapes)
    for part in (*forces, *effects):
        for field in declared(part, "reads"):
            if field not in state.fields():
                raise ValueError(
                    f"{name_of(part)} reads {field!r}, which nothing provides: add an effect that writes it"
                    f"{_PROVIDERS.get(field, '')}, or give it with the state, state.replace({field}=...)"
                )
    return state


def _check_order(effects: tuple[Any, ...]) -> None:
    """ValueError where an effect stands on the side of another from which it cannot see what that does."""

    def has_births(effect):
        return acts(effect) == BEFORE and hasattr(unwrapped(effect), "max_births")

    def kills(effect):
        return acts(effect) == BEFORE and "alive" in declared(effect, "writes") and not has_births(effect)

    for k, effect in enumerate(effects):
        before, after = effects[:k], effects[k + 1 :]
        hiding, where = [], ""
        if needs(effect, "the events") and acts(effect) == BEFORE:
            where = "after the deaths that it looks at, and before the births that fill their slots"
            last = max((n for n, other in enumerate(before) if kills(other)), default=k)
            filled = [other for other in before[last:] if has_births(other) and not needs(other, "the events")]
            hiding = [*(other for other in after if kills(other)), *filled]
        elif needs(effect, "the events"):
            where = "after the colliders, as it looks at where particles are after them"
            hiding = [other for other in after if "unresolved_contacts" in declared(other, "writes")]
        elif needs(effect, "the last place"):
            where = "last, after all that acts after the motion"
            hiding = [other for other in after if acts(other) == AFTER]
        if hiding:
            raise ValueError(
                f"{name_of(effect)} must stand in Scene.effects {where}, got it on the wrong side of "
                f"{name_of(hiding[0])}; move one of the two"
            )


_PROVIDERS = {
    "age": " (Lifetime)",
    "lifetime": " (Emitter with lifetime=...), or name a duration",
    "alive": " (Emitter, Lifetime)",
}
