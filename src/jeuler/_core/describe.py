"""How objects are displayed: on one screen of a terminal, and as a table in a notebook."""

from __future__ import annotations

import dataclasses
import html
import itertools
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import jax
import numpy as np

WIDTH, LINES = 100, 24  # of a screen
MOST_ITEMS = 6  # of a sequence or mapping
MOST_LETTERS = 160  # of a string

Part = str | tuple[str, list["Part"], str]  # a text, or what opens, the parts within, and what closes


def summary(x: Any) -> str:
    """A short description of x: names, single numbers, dtypes and shapes of arrays, never more than a screen."""
    for depth in (6, 4, 3, 2, 1):
        lines = _lines(_parts(x, depth), 0, "")
        if len(lines) <= LINES:
            break
    return "\n".join([*lines[:LINES], *(["..."] if len(lines) > LINES else [])])


def array_type(x: Any) -> str:
    """dtype and shape of an array, such as float32[100,3]."""
    return f"{x.dtype}[{','.join(map(str, x.shape))}]"


def fields_of(x: Any) -> list[tuple[str, Any]] | None:
    """The named fields of a dataclass or named tuple; None for anything else. What is absent (None) is left out."""
    if dataclasses.is_dataclass(x) and not isinstance(x, type):
        names = tuple(field.name for field in dataclasses.fields(x) if field.repr)
    elif isinstance(x, tuple) and hasattr(x, "_fields"):
        names = x._fields
    else:
        return None
    fields = ((name, getattr(x, name, None)) for name in names)
    return [(name, value) for name, value in fields if value is not None]


def _parts(x: Any, depth: int) -> Part:
    if callable(inner := getattr(x, "function", None)) and len(vars(x)) == 1:  # a function that was wrapped
        x = inner
    if hasattr(x, "shape") and hasattr(x, "dtype"):
        return array_type(x) if np.ndim(x) else values_of(x) or array_type(x)
    fields = fields_of(x)
    name = type(x).__name__
    if fields is not None:
        return _group(f"{name}(", [(f"{field}=", value) for field, value in fields], ")", depth)
    if isinstance(x, Mapping):
        return _group("{", [(f"{key!r}: ", value) for key, value in x.items()], "}", depth)
    if isinstance(x, (tuple, list)):
        opening, closing = "[]" if isinstance(x, list) else ("(", ",)" if len(x) == 1 else ")")
        return _group(opening, [("", value) for value in x], closing, depth)
    if isinstance(x, str):
        return repr(x if len(x) <= MOST_LETTERS else x[: MOST_LETTERS - 3] + "...")
    if callable(x) and hasattr(x, "__qualname__"):
        return x.__qualname__.rpartition("<locals>.")[2]
    text = repr(x)
    return text if len(text) <= MOST_LETTERS and "\n" not in text else f"{name}(...)"


def _group(opening: str, items: Sequence[tuple[str, Any]], closing: str, depth: int) -> Part:
    if items and depth == 0:
        return f"{opening}...{closing}"
    most = len(items) if opening[:-1] else MOST_ITEMS  # all fields of an object, some items of a sequence
    parts: list[Part] = []
    for label, value in items[:most]:
        part = _parts(value, depth - 1)
        parts.append(label + part if isinstance(part, str) else (label + part[0], *part[1:]))
    if len(items) > most:
        parts.append(f"... {len(items) - most} more")
    return opening, parts, closing


def _flat(part: Part) -> str:
    return part if isinstance(part, str) else part[0] + ", ".join(map(_flat, part[1])) + part[2]


def _lines(part: Part, indent: int, end: str) -> list[str]:
    """The part in one line if that is short enough, or each part within on lines of its own."""
    flat = " " * indent + _flat(part) + end
    if isinstance(part, str) or len(flat) <= WIDTH:
        return [flat]
    inner = [line for p in part[1] for line in _lines(p, indent + 2, ",")]
    return [" " * indent + part[0], *inner, " " * indent + part[2] + end]


def table(title: str, rows: Iterable[Sequence[Any]], head: Sequence[str] = (), note: str = "") -> str:
    """Rows of a table in HTML, with a title above and a note below."""

    def row(cells: Sequence[Any], kind: str) -> str:
        style = ' style="text-align: left"'
        return "<tr>" + "".join(f"<{kind}{style}>{html.escape(str(cell))}</{kind}>" for cell in cells) + "</tr>"

    body = "".join([row(head, "th") if head else "", *(row(cells, "td") for cells in rows)])
    below = f"<div>{html.escape(note)}</div>" if note else ""
    return f"<div><b>{html.escape(title)}</b></div><table>{body}</table>{below}"


def text_table(title: str, rows: Iterable[Sequence[Any]], head: Sequence[str] = (), note: str = "") -> str:
    """The same for a terminal: at most a screen, columns one below the other, the note at the top."""
    lines = [[str(cell) for cell in row] for row in (*([head] if head else []), *rows)]
    widths = [max(map(len, column)) for column in itertools.zip_longest(*lines, fillvalue="")]
    shown = ["  ".join(map(str.ljust, row, widths)).rstrip() for row in lines]
    above = textwrap.wrap(f"{title}: {note}" if note else title, WIDTH, max_lines=5)
    room = LINES - len(above)
    hidden = [f"... {len(shown) - room + 1} more"] if len(shown) > room else []
    return "\n".join([*above, *(_cut(line) for line in shown[: room - len(hidden)]), *hidden])


def _cut(line: str) -> str:
    return line if len(line) <= WIDTH else f"{line[: WIDTH - 3]}..."


def object_table(x: Any) -> str:
    """An object as a table of its fields: what each is, and its value or the range of its values."""
    rows = [(name, *_type_and_values(value)) for name, value in fields_of(x) or ()]
    return table(type(x).__name__, rows, ("field", "type", "values"))


def _type_and_values(x: Any) -> tuple[str, str]:
    if hasattr(x, "shape") and hasattr(x, "dtype"):
        return array_type(x), values_of(x)
    text = summary(x)
    return type(x).__name__, text if len(text) <= MOST_LETTERS else text[: MOST_LETTERS - 3] + "..."


def values_of(x: Any) -> str:
    """Up to three numbers as they are, or the range of more; nothing of what is traced or has no values."""
    if isinstance(x, (jax.core.Tracer, jax.ShapeDtypeStruct)) or not x.size:
        return ""
    if jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key):
        return ""
    numbers = np.asarray(x).ravel()
    if numbers.size <= 3:
        return ", ".join(f"{number:.6g}" if numbers.dtype.kind in "fiu" else str(number) for number in numbers)
    if numbers.dtype == bool:
        return f"{np.count_nonzero(numbers)} of {numbers.size} true"
    if numbers.dtype.kind not in "fiu":
        return ""
    known = numbers[np.isfinite(numbers)]
    span = f"{known.min():.6g} to {known.max():.6g}" if known.size else ""
    others = [f"{np.count_nonzero(bad)} {name}" for name, bad in _not_finite(numbers) if bad.any()]
    return ", ".join([span] * bool(span) + others)


def _not_finite(numbers: np.ndarray) -> list[tuple[str, np.ndarray]]:
    return [("inf", np.isinf(numbers)), ("NaN", np.isnan(numbers))]
