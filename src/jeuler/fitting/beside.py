"""What is kept beside a result as long as it lives: not part of it, not copied with it."""

from __future__ import annotations

import weakref
from typing import Any

_ATTACHED: dict[tuple[int, str], Any] = {}  # by the id of a result and the name of what is kept


def attach(result: Any, name: str, what: Any) -> None:
    """Keep something beside a result until the result is gone."""
    if what is not None:
        key = (id(result), name)
        _ATTACHED[key] = what
        weakref.finalize(result, _ATTACHED.pop, key, None)


def attached(result: Any, name: str) -> Any:
    """What was kept beside a result; None beside a copy."""
    return _ATTACHED.get((id(result), name))
