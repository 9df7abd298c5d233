"""Calls with a wrong argument: one ValueError that says what to write, in place of Python's TypeError."""

from __future__ import annotations

import difflib
import functools
import inspect
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")


def says_what_to_write(**instead: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """A decorator: a call with missing, unknown or misplaced arguments is one ValueError that names the right ones.

    ``instead``: what to write for a name that people may try. A right call costs nothing more.
    """

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        @functools.wraps(function)
        def checked(*args: P.args, **named: P.kwargs) -> R:
            try:
                return function(*args, **named)
            except TypeError:
                problem = mistake(function, args, named, instead)
                if problem is None:
                    raise
            raise ValueError(problem)

        return checked

    return decorate


def constructor_says_what_to_write(cls: type) -> None:
    """The same for the ``__init__`` of a class."""
    init = cls.__init__  # type: ignore[misc]  # of the class itself, made by dataclass

    @functools.wraps(init)
    def __init__(self: Any, *args: Any, **named: Any) -> None:
        try:
            init(self, *args, **named)
            return
        except TypeError:
            problem = mistake(init, (self, *args), named, {}, name=cls.__name__)
            if problem is None:
                raise
        raise ValueError(problem)

    cls.__init__ = __init__  # type: ignore[misc]  # as above


def mistake(function: Callable, args: tuple, named: dict, instead: dict[str, str], name: str = "") -> str | None:
    """What is wrong with the arguments of a call and what to write, or None if they fit."""
    parameters = inspect.signature(function).parameters
    name = name or function.__name__
    own = [p for p in parameters.values() if p.name != "self"]
    given = len(args) - ("self" in parameters)
    places = [p.name for p in own if p.kind is p.POSITIONAL_OR_KEYWORD]
    keywords = [p.name for p in own if p.kind is p.KEYWORD_ONLY]
    for key in named:
        if key not in parameters:
            return f"{name} takes no argument {key!r}; {_meant(key, (*places, *keywords), instead)}"
    if given > len(places):
        required = [p.name for p in own if p.kind is p.KEYWORD_ONLY and p.default is p.empty]
        written = ", ".join([*places, *(f"{key}=..." for key in required or keywords[:2])])
        return f"{name} takes {len(places)} arguments by place, got {given}; write {name}({written})"
    for key in places[:given]:
        if key in named:
            return f"{name} got {key!r} twice, by place and by name; write it once"
    filled = {*places[:given], *named}
    missing = [p.name for p in own if p.default is p.empty and p.name not in filled and p.kind is not p.VAR_KEYWORD]
    if missing:
        written = ", ".join([*places[:given], *(f"{key}=..." for key in (*named, *missing))])
        return f"{name} needs {' and '.join(missing)}; write {name}({written})"
    return None


def _meant(key: str, names: tuple[str, ...], instead: dict[str, str]) -> str:
    if key in instead:
        return f"write {instead[key]}"
    near = near_name(key, names)
    return f"did you mean {near}=...?" if near else f"it takes {', '.join(names)}"


def near_name(name: str, names: Any, cutoff: float = 0.65) -> str | None:
    """The name that a user who wrote ``name`` is likely to have meant; None if none is near."""
    for other in names:
        if sorted(name) == sorted(other):  # letters swapped, which in short names are much of the name
            return other
    found = difflib.get_close_matches(name, list(names), n=1, cutoff=cutoff)
    return found[0] if found else None
