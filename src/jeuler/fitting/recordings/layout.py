"""How a text file lays out its table: the separator, where the numbers begin, which lines name the columns."""

from __future__ import annotations

import collections
import csv
import dataclasses
import re

from jeuler.fitting.recordings.cells import is_missing, is_value, shown
from jeuler.fitting.recordings.table import Line, counted, listed
from jeuler.fitting.recordings.units import is_unit, quantity_of, split_unit

SEPARATORS = (";", "\t", ",", " ")
SAMPLE_LINES, SAMPLE_CHARACTERS = 200, 2_000_000
DECIMAL_COMMAS = "; decimal commas cannot be told from separators: export with semicolons or with decimal points"
NUMBERS_ABOVE = 5  # a header may hold lines of numbers, such as those of its markers: names come within so many lines
MOST_COLUMNS = 5_000
HEADER_LINES = 300  # numbers begin before this line
ERROR_CELLS = ("#N/A", "#NA", "#DIV", "#VALUE", "#REF", "#NUM", "#NAME", "#NULL", "#WERT", "#BEZUG", "#ZAHL", "#NV")


@dataclasses.dataclass(frozen=True)
class Layout:
    """The separator, how many columns there are, where the data begin among the lines, names, units, text columns."""

    separator: str
    width: int
    begin: int
    names: list[str] | None
    units: list[str]
    text: frozenset[int]
    notes: tuple[str, ...]


def is_comment(line: str) -> bool:
    """Whether a line is a comment: it begins with #, % or //, and not with a spreadsheet's error such as #N/A."""
    start = line.lstrip()[:8]
    return start.startswith(("#", "%", "//")) and not start.upper().startswith(ERROR_CELLS)


def split(name: str, line: Line, separator: str) -> list[str]:
    """The cells of a line."""
    number, text = line
    if '"' not in text:
        return text.split() if separator == " " else [cell.strip() for cell in text.split(separator)]
    try:
        cells = next(csv.reader([text], delimiter=separator, skipinitialspace=True))
    except csv.Error as error:
        raise ValueError(f"{name}: line {number}: cannot be split into cells ({error})") from None
    return [cell.strip() for cell in cells if separator != " " or cell.strip()]


def find_layout(name: str, lines: list[Line], comments: list[Line]) -> Layout:
    """The layout of the lines that are no comments."""
    separator, raw_width, sample = _separator(name, lines)
    if not raw_width:
        raise _no_table(name, lines)
    if raw_width > MOST_COLUMNS:
        raise ValueError(
            f"{name}: line {lines[0][0]}: {raw_width} columns, at most {MOST_COLUMNS}; is each row a line, and the "
            f"separator right? Save the time and the columns that matter"
        )
    trailing = all(not cells[-1] for cells in sample)
    head, begin = _head(name, lines, separator, raw_width, _text_columns(sample, raw_width))
    rows = [_header_cells(name, line, separator, raw_width - trailing) for line in head]
    trailing = trailing and not any(len(row) == raw_width for row in rows)
    width = raw_width - trailing
    named = [row for row in rows if len(row) == width]
    named = [row for row in named if not any(map(is_value, row))] or named
    if not named and head:
        named = [row for row in [_cells_by_any_separator(head[-1][1], width)] if row]
        if not named:
            _refuse_other_width(name, lines, begin, rows, width)
    names, units, notes = _names(named, _commented(comments, width), width)
    text = frozenset(k for k in _text_columns(sample, raw_width) if k < width)
    return Layout(separator, width, begin, names, units, text, notes)


def _separator(name: str, lines: list[Line]) -> tuple[str, int, list[list[str]]]:
    """The separator under which most cells are numbers, the width of its rows, and those of the sample."""
    sample: list[Line] = []
    size = 0
    step = max(1, len(lines) // (SAMPLE_LINES // 2))
    for line in lines[: SAMPLE_LINES // 2] + lines[SAMPLE_LINES // 2 :: step]:
        size += len(line[1])
        if sample and size > SAMPLE_CHARACTERS:
            break
        sample.append(line)
    best: tuple[float, str, int, list[list[str]]] = (0.0, " ", 0, [])
    for separator in SEPARATORS:
        if separator != " " and not any(separator in text for _, text in sample):
            continue
        rows, shares = [], []
        for line in sample:
            cells = split(name, line, separator)
            values, missing = sum(map(is_value, cells)), sum(map(is_missing, cells))
            if values >= 1 and values + missing >= 2:
                rows.append(cells)
                shares.append((values + missing) / len(cells))
        if not rows:
            continue
        width = collections.Counter(map(len, rows)).most_common(1)[0][0]
        score = sum(share for cells, share in zip(rows, shares, strict=True) if len(cells) == width)
        if score > 1.01 * best[0]:
            best = score, separator, width, [cells for cells in rows if len(cells) == width]
    return best[1], best[2], best[3]


def _text_columns(sample: list[list[str]], width: int) -> frozenset[int]:
    """Columns of which no cell in the sample is a number, though some hold text."""
    if len(sample) < 5:
        return frozenset()
    columns = ([row[k] for row in sample] for k in range(width))
    return frozenset(k for k, cells in enumerate(columns) if not any(is_value(c) or is_missing(c) for c in cells))


def _head(name: str, lines: list[Line], separator: str, width: int, text: frozenset[int]) -> tuple[list[Line], int]:
    """The lines above the data, and where the data begin: after the last line of names above the first good row."""
    first_good = len(lines)
    for k, line in enumerate(lines[:HEADER_LINES]):
        cells = split(name, line, separator)
        good = len(cells) == width and any(map(is_value, cells))
        if good and all(j in text or is_value(cell) or is_missing(cell) for j, cell in enumerate(cells)):
            first_good = _below_names(name, lines, k, separator, width)
            break
    if first_good == len(lines):
        first_good = min(len(lines), HEADER_LINES)
    for k in range(first_good - 1, -1, -1):
        cells = split(name, lines[k], separator)
        if not any(map(is_value, cells)):
            return lines[: k + 1], k + 1
    begin = first_good
    for k in range(first_good):
        cells = split(name, lines[k], separator)
        if len(cells) == width or all(map(is_value, cells)):
            begin = k
            break
    return lines[:begin], begin


def _below_names(name: str, lines: list[Line], k: int, separator: str, width: int) -> int:
    """The first line of data: ``k``, or after the line of names that follows close by, if none stands above."""

    def names(line: Line) -> bool:
        cells = split(name, line, separator)
        return len(cells) == width and all(cells) and not any(is_value(cell) or is_missing(cell) for cell in cells)

    if any(map(names, lines[:k])):
        return k
    return next((j + 1 for j in range(k + 1, min(k + NUMBERS_ABOVE, len(lines) - 1)) if names(lines[j])), k)


def _header_cells(name: str, line: Line, separator: str, width: int) -> list[str]:
    """The cells of a line above the data, without empty ones at the end."""
    cells = split(name, line, separator)
    while len(cells) > width and not cells[-1]:
        cells = cells[:-1]
    return cells


def _cells_by_any_separator(text: str, width: int) -> list[str]:
    """The cells of a line under the first separator that gives so many of them; none if no one does."""
    for pattern in (r"\t", ";", ",", r"\s{2,}", r"[,;\s]+"):
        cells = [cell.strip().strip('"') for cell in re.split(pattern, text.strip())]
        while len(cells) > width and not cells[-1]:
            cells = cells[:-1]
        if len(cells) == width and any(cells) and not any(is_value(cell) for cell in cells):
            return cells
    return []


def _commented(comments: list[Line], width: int) -> list[list[str]]:
    """Names and units in comments: what follows ``columns:`` before words that are known as such."""
    told, known = [], []
    for _, line in comments[:HEADER_LINES]:
        text = line.lstrip().lstrip("#%/").strip()
        label = re.match(r"(?:columns?|fields?|names?)\s*[:=]\s*(.*)", text, re.IGNORECASE)
        cells = _cells_by_any_separator(label.group(1) if label else text, width)
        if label and cells:
            told.append(cells)
        elif cells and sum(is_unit(cell) or quantity_of(cell) != "" for cell in cells) * 2 >= width:
            known.append(cells)
    return told + known


def _names(
    rows: list[list[str]], comments: list[list[str]], width: int
) -> tuple[list[str] | None, list[str], tuple[str, ...]]:
    """Names and units among the lines above the data and the comments."""
    units = next((row for row in [*rows, *comments] if _are_units(row)), None)
    named = [row for row in rows if row is not units] or [row for row in comments if row and row is not units]
    if not named and rows:
        named, units = rows, None  # names that could be units: t, m
    names = max(named, key=lambda row: (sum(map(bool, row)), _known(row))) if named else None
    notes = []
    if names is not None and not rows:
        notes.append("The names stand in a comment.")
    if units is not None:
        notes.append("A row of units stands above the data.")
    return names, units or [""] * width, tuple(notes)


def _known(row: list[str]) -> int:
    """How many cells name a quantity or hold a unit: a title of as many words as there are columns does so rarely."""
    return sum(quantity_of(cell) != "" or split_unit(cell)[1] != "" for cell in row)


def _are_units(row: list[str]) -> bool:
    filled = [cell for cell in row if cell]
    bracketed = sum(cell[:1] in "[(" for cell in filled)
    names = sum(quantity_of(cell) != "" and not is_unit(cell) for cell in filled)
    return bool(filled) and not names and sum(map(is_unit, filled)) + bracketed >= max(1, (len(filled) + 1) // 2)


def _refuse_other_width(name: str, lines: list[Line], begin: int, rows: list[list[str]], width: int) -> None:
    """Names right above the data that are more or fewer than its columns are an error, a title is not."""
    if len(rows[-1]) >= 2 and begin < len(lines) and sum(quantity_of(c) != "" for c in rows[-1]) * 2 >= len(rows[-1]):
        hint = DECIMAL_COMMAS if width == 2 * len(rows[-1]) else ""
        raise ValueError(
            f"{name}: line {lines[begin][0]}: {counted(width, 'cell')}, expected {len(rows[-1])}: "
            f"{listed(rows[-1])}{hint}"
        )


def _no_table(name: str, lines: list[Line]) -> ValueError:
    """What to say of a file in which no line has two numbers."""
    number, text = lines[0]
    separator = next((s for s in SEPARATORS[:-1] if s in text), " ")
    header = split(name, lines[0], separator)
    for line in lines[:HEADER_LINES]:
        cells = split(name, line, separator)
        if len(header) > 1 and any(map(is_value, cells)):
            if len(cells) != len(header):
                return ValueError(
                    f"{name}: line {line[0]}: {counted(len(cells), 'cell')}, expected {len(header)}: {listed(header)}"
                )
            bad = next((k for k, c in enumerate(cells) if not (is_value(c) or is_missing(c))), None)
            if bad is not None:
                return ValueError(
                    f"{name}: line {line[0]}: column {bad + 1} ({header[bad][:60]}): "
                    f"expected a number, got {shown(cells[bad])}"
                )
    if any(is_value(text.strip()) for _, text in lines[:HEADER_LINES]):
        return ValueError(
            f"{name}: line {number}: one column, expected a time and at least one value, "
            f"separated by commas, semicolons, tabs or blanks"
        )
    return ValueError(f"{name}: line {number}: only names and no numbers, expected rows of numbers")
