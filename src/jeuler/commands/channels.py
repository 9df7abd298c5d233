"""Which columns of a recording are fitted, and what each particle is made of."""

from __future__ import annotations

import csv
import re
from typing import Any

import numpy as np

from jeuler.fitting.recordings.columns import Column
from jeuler.fitting.recordings.recording import Recording
from jeuler.fitting.recordings.table import listed
from jeuler.fitting.spectrum import strong_lines

OBSERVED = (
    "position",
    "angle",
    "acceleration",
    "velocity",
    "angular velocity",
)  # the first of these that the file has is taken
MOST_CHANNELS = 30
ALIKE = ("force", "voltage")  # or else one of these: what a sensor says of a motion has its frequency and its decay


def resolve(name: str, available: list[str]) -> str | None:
    """The column that is meant: by its name, or else, where only one fits, in another case or by its first word."""
    if name in available:
        return name
    alike = [a for a in available if a.lower() == name.lower()] or [
        a for a in available if name and re.match(re.escape(name.lower()) + r"($|[^a-z0-9])", a.lower())
    ]
    return alike[0] if len(alike) == 1 else None


def input_column(recording: Recording, arguments: Any) -> Column:
    """The column of the measured force, or of the measured position of the support."""
    option, given = ("--input", arguments.input) if arguments.support is None else ("--support", arguments.support)
    name = resolve(given, [c.name for c in recording.columns])
    if name is None:
        names = listed([c.name for c in recording.columns])
        raise ValueError(f"{recording.source}: {option} {given!r} is no column; the columns are {names}")
    column = next(c for c in recording.columns if c.name == name)
    if arguments.support is not None and column.quantity not in ("position", ""):
        raise ValueError(
            f"{recording.source}: --support {given}: is of {column.quantity}, expected a position; "
            f"say its unit with --unit, or give the force that acts with --input"
        )
    return column


def choose_columns(recording: Recording, arguments: Any) -> tuple[list[Column], str, int, list[tuple[str, str]]]:
    """The columns to fit, their quantity, the coordinates per particle, and the columns left out with the reasons."""
    driven = arguments.input is not None or arguments.support is not None
    drive = input_column(recording, arguments) if driven else None
    usable = [c for c in recording.columns if c.quantity != "text" and c != drive]
    if arguments.columns is not None:
        columns = _named_columns(recording, arguments.columns)
        quantity = arguments.observe or columns[0].quantity
        others = [(c.name, "not among --columns") for c in recording.columns if c not in columns and c != drive]
    else:
        held = dict(zip((c.index for c in recording.columns), np.isfinite(recording.values).any(axis=0), strict=True))
        usable = [c for c in usable if held[c.index]]
        quantity = _quantity(recording, usable, arguments.observe)
        columns = [c for c in usable if c.quantity == quantity]
        taken, there = {c.index for c in columns}, {c.index for c in usable}
        others = [
            (c.name, _reason(c, quantity, c.index in there))
            for c in recording.columns
            if c.index not in taken and c != drive
        ]
    quantity = quantity if quantity in OBSERVED else "position"
    if arguments.columns is None and len(columns) > MOST_CHANNELS and not _takes_all(arguments):
        raise ValueError(
            f"{recording.source}: {len(columns)} columns are of {quantity}, at most {MOST_CHANNELS} are fitted "
            f"without --columns: {listed([c.name for c in columns])}; choose with it"
        )
    if arguments.columns is None and arguments.dim is None and not _takes_all(arguments):
        columns, still = _without_still(recording, columns)
        columns, more = _one_channel(recording, columns)
        others += still + more
    columns, dim = _particles(recording.source, columns, arguments)
    return columns, quantity, dim, others


def _takes_all(arguments: Any) -> bool:
    """Whether every track counts, as for ``find``: what rests may be what others hang on."""
    return getattr(arguments, "job", "") == "find"


def _quantity(recording: Recording, usable: list[Column], observe: str | None) -> str:
    there = {c.quantity for c in usable}
    if observe is not None:
        if observe not in there and "" not in there:
            raise ValueError(
                f"{recording.source}: --observe {observe}: no column is one; the columns are "
                f"{listed([f'{c.name} ({c.quantity})' for c in usable])}; choose with --columns"
            )
        return observe if observe in there else ""
    for quantity in (*OBSERVED, *ALIKE):
        if quantity in there:
            return quantity
    if "" in there:
        return ""
    raise ValueError(
        f"{recording.source}: no column is a position, an angle, an acceleration or a velocity; the columns are "
        f"{listed([f'{c.name} ({c.quantity})' for c in usable]) or 'none'}; choose with --columns and --observe"
    )


def _reason(column: Column, quantity: str, usable: bool) -> str:
    if column.quantity == "text":
        return "text"
    if not usable:
        return "no values"
    kinds = {
        "": "unknown quantity",
        "index": "an index of the rows",
        "absolute": "an absolute value, which has lost the sign",
        "uncertainty": "an uncertainty",
    }
    return kinds.get(column.quantity, f"{column.quantity}; {quantity or 'another'} is fitted")


def _named_columns(recording: Recording, text: str) -> list[Column]:
    """The columns of a list of names; a name may contain commas and quotes."""
    available = [c.name for c in recording.columns if c.quantity != "text"]
    names = _split_names(text, available)
    unknown = [name for name in names if name not in available]
    if unknown or not names:
        raise ValueError(
            f"{recording.source}: no column {unknown[0] if unknown else text!r}, the columns are {listed(available)}"
            if unknown or text
            else f"--columns must name columns, got an empty text; the columns are {listed(available)}"
        )
    repeated = [name for name in names if names.count(name) > 1]
    if repeated:
        raise ValueError(f"--columns names {repeated[0]!r} more than once")
    columns = [recording.columns[[c.name for c in recording.columns].index(name)] for name in names]
    kinds = {c.quantity for c in columns if c.quantity}
    if len(kinds) > 1:
        raise ValueError(f"--columns must name one quantity, got {', '.join(sorted(kinds))}")
    return columns


def _split_names(text: str, available: list[str]) -> list[str]:
    """Names separated by commas: in quotes, or the longest run of parts that is a name of a column."""
    if text in available:
        return [text]
    parts = [part.strip() for part in next(csv.reader([text], skipinitialspace=True), [])]
    names: list[str] = []
    while parts:
        for count in range(len(parts), 0, -1):
            found = resolve(", ".join(parts[:count]), available) or resolve(",".join(parts[:count]), available)
            if found is not None:
                break
        names.append(found or parts[0])
        parts = parts[count if found else 1 :]
    return names


def _without_still(recording: Recording, columns: list[Column]) -> tuple[list[Column], list[tuple[str, str]]]:
    """The columns without axes, or channels, along which nothing moves: a residual of 0 makes errors too small."""
    seen = np.isfinite(recording.values)
    moves = [
        bool(np.ptp(v[there])) if there.any() else False for v, there in zip(recording.values.T, seen.T, strict=True)
    ]
    moving = [c for c, moved in zip(recording.columns, moves, strict=True) if moved and c in columns]
    axes = {c.axis for c in moving}
    kept = [c for c in columns if c.axis in axes] if all(c.axis for c in columns) else moving
    if not kept:
        return columns, []
    return kept, [(c.name, "nothing moves there; choose it with --columns") for c in columns if c not in kept]


def _one_channel(recording: Recording, columns: list[Column]) -> tuple[list[Column], list[tuple[str, str]]]:
    """Of several channels that no axis or number tells apart, the one that oscillates most clearly."""
    if len(columns) < 2 or any(c.axis or _number_of(c) for c in columns) or not all(c.told for c in columns):
        return columns, []
    clearest = max(columns, key=lambda c: _clearness(recording, c))
    others = [
        (c.name, "another channel, whose oscillation is less clear; choose it with --columns")
        for c in columns
        if c is not clearest
    ]
    return [clearest], others


def _clearness(recording: Recording, column: Column) -> float:
    """The squared amplitude of the strongest spectral line over the variance."""
    x = recording.values[:, recording.columns.index(column)]
    lines = strong_lines(recording.times, x, most=1)
    return lines[0][1] ** 2 / np.nanvar(x) if lines else 0.0


def _number_of(column: Column) -> str:
    found = re.search(r"[A-Za-z_](\d+)(?=$|[^A-Za-z0-9]|_)", column.name)
    return found.group(1) if found and column.told else ""


def _particles(source: str, columns: list[Column], arguments: Any) -> tuple[list[Column], int]:
    """The columns particle by particle, and the coordinates per particle."""
    axes = [c.axis for c in columns]
    if all(axes):
        guessed = len(set(axes))
    elif any(_number_of(c) for c in columns) and all(c.told for c in columns):
        guessed = 1
    else:
        guessed = len(columns) if len(columns) <= 3 else 1
    dim = guessed if arguments.dim is None else arguments.dim
    if dim < 1 or len(columns) % dim:
        raise ValueError(
            f"{source}: {len(columns)} columns ({listed([c.name for c in columns])}) do not make particles of "
            f"{dim} coordinates; choose with --columns and --dim"
        )
    if dim > 1 and all(axes) and any(len(set(axes[k : k + dim])) < dim for k in range(0, len(axes), dim)):
        columns = sorted(columns, key=lambda c: (int(c.marker) if c.marker.isdigit() else 0, c.marker, c.axis))
    return columns, dim
