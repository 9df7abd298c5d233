"""What one cell of a table says: a number, a date or a time of day, nothing, or text."""

from __future__ import annotations

import datetime
import math
import re

MISSING = frozenset(
    {"", "nan", "na", "n/a", "null", "none", "-", "--", "#n/a", "#na", "#div/0!", "#value!", "#ref!", "#num!", "#name?"}
    | {"#null!", "#wert!", "#bezug!", "#zahl!", "#nv", "missing", "nan.0", "-nan", "+nan", "nan(ind)", "-nan(ind)"}
)
NUMBER = re.compile(r"[+-]?(\d+([.,]\d*)?|[.,]\d+)([eE][+-]?\d+)?", re.ASCII)
DATE = re.compile(r"(\d{1,4})([-/.])(\d{1,2})\2(\d{1,4})(?:[T\s]+(.+))?", re.ASCII)
CLOCK = re.compile(r"(\d{1,2}):(\d{2})(?::(\d{2})(?:[.,:](\d{1,9}))?)?\s*([AaPp]\.?[Mm]\.?)?", re.ASCII)
NAMED_MONTH = re.compile(r"(\d{1,2})[-/ ]([A-Za-z]{3})[a-z]*\.?[-/ ](\d{4})(?:[T\s]+(.+))?", re.ASCII)
MONTHS = ("jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec")
MINUTES = re.compile(r"(\d{1,3}):([0-5]\d)[.,](\d{1,9})", re.ASCII)
THOUSANDS = re.compile(r"[+-]?\d{1,3}(?:(,\d{3})+\.\d*|(\.\d{3})+,\d*)", re.ASCII)
ZONE = re.compile(r"\s*(Z|UTC|GMT|[+-]\d{2}:?\d{2})$")


def is_missing(cell: str) -> bool:
    """Whether a cell says that there is no value."""
    return cell.lower() in MISSING


def number(cell: str, comma: bool = True) -> float:
    """The value of a cell, NaN for a missing one; ValueError if it is not a finite number.

    ``comma``: whether a comma may stand for the decimal point.
    """
    if not NUMBER.fullmatch(cell):
        if is_missing(cell):
            return math.nan
        found = THOUSANDS.fullmatch(cell)
        if not found or (found.group(2) and not comma):
            raise ValueError
        return float(cell.replace(",", "") if found.group(1) else cell.replace(".", "").replace(",", "."))
    if "," in cell:
        if not comma:
            raise ValueError
        cell = cell.replace(",", ".")
    value = float(cell)
    if not math.isfinite(value):
        raise ValueError
    return value


def moment(cell: str) -> tuple[int | None, float | None] | None:
    """The day (its ordinal; None without a date) and the second of the day (None without a clock); None if neither."""
    cell = ZONE.sub("", cell)
    if found := DATE.fullmatch(cell):
        first, _, second, third, clock = found.groups()
        day = _day(int(first), int(second), int(third), len(first) > 2)
        seconds = _seconds(clock) if clock else None
        return None if day is None or (clock and seconds is None) else (day, seconds)
    if (found := NAMED_MONTH.fullmatch(cell)) and found.group(2).lower() in MONTHS:
        first, month, third, clock = found.groups()
        day = _day(int(third), MONTHS.index(month.lower()) + 1, int(first), year_first=True)
        seconds = _seconds(clock) if clock else None
        return None if day is None or (clock and seconds is None) else (day, seconds)
    clock_only = _seconds(cell)
    return None if clock_only is None else (None, clock_only)


def _day(first: int, second: int, third: int, year_first: bool) -> int | None:
    """Year-month-day, or else day and month in the order that a calendar allows, then the year."""
    if year_first:
        order = [(first, second, third)]
    else:
        year = third + 2000 if third < 100 else third
        order = [(year, second, first), (year, first, second)]
    for year, month, day in order:
        try:
            return datetime.date(year, month, day).toordinal()
        except ValueError:
            continue
    return None


def _seconds(cell: str) -> float | None:
    if found := MINUTES.fullmatch(cell):  # minutes, seconds and a fraction: a video's time
        return int(found.group(1)) * 60 + int(found.group(2)) + float("0." + found.group(3))
    found = CLOCK.fullmatch(cell)
    if not found:
        return None
    hour, minute, second, fraction, half = found.groups()
    hours = int(hour)
    if half:
        hours = hours % 12 + (12 if half[0] in "Pp" else 0)
    if hours > 24 or int(minute) > 59 or int(second or 0) > 60:
        return None
    return hours * 3600 + int(minute) * 60 + int(second or 0) + (float("0." + fraction) if fraction else 0.0)


def is_value(cell: str) -> bool:
    """Whether a cell is a number, a date or a time of day."""
    try:
        return not math.isnan(number(cell))
    except ValueError:
        return moment(cell) is not None


def shown(cell: str) -> str:
    """A cell as a message shows it: quoted, and cut where it is long."""
    return repr(cell) if len(cell) <= 40 else f"{cell[:30]!r}... ({len(cell)} characters)"
