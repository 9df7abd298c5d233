"""What loggers write around their numbers: labels before each, a stamp before each line, a header with its own end."""

from __future__ import annotations

import re

from jeuler.fitting.recordings.table import Line

MOST = 200  # lines are looked at
NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
LABELLED = re.compile(rf"\s*\"?([A-Za-z_][\w .]*?)\"?\s*[:=]\s*({NUMBER})\s*(?:[,;\t ]\s*|$)", re.ASCII)
STAMP = re.compile(r"(\d{1,2}:\d{2}:\d{2}[.,]\d+) -> ?")
HEADER_ENDS = "***End_of_Header***"  # LabVIEW's


def table_of_labels(lines: list[Line]) -> list[Line]:
    """Lines such as ``t:0.04,x:0.31`` as a line of names and lines of cells, if all at the top are such."""
    labels = _labels(lines[0][1]) if lines else None
    if not labels or any(_names(_labels(text)) != _names(labels) for _, text in lines[:MOST]):
        return lines
    rows = []
    for number, text in lines:
        found = _labels(text)
        complete = _names(found) == _names(labels)
        rows.append((number, "\t".join(value for _, value in found) if found and complete else text))
    return [(lines[0][0], "\t".join(name for name, _ in labels)), *rows]


def _labels(text: str) -> list[tuple[str, str]] | None:
    """Labels and numbers of a line that holds nothing else; braces around it are left out."""
    text = text.strip()
    if text.startswith("{") and text.endswith("}"):
        text = text[1:-1]
    found, place = [], 0
    while match := LABELLED.match(text, place):
        found.append((match.group(1), match.group(2)))
        place = match.end()
    return found if len(found) >= 2 and place == len(text) else None


def _names(labels: list[tuple[str, str]] | None) -> list[str]:
    return [name for name, _ in labels or []]


def without_stamps(lines: list[Line]) -> list[Line]:
    """Lines without what a serial monitor puts before each, ``16:38:00.123 -> ``, unless that is the only clock."""
    if not lines or not all(STAMP.match(text) for _, text in lines[:MOST]):
        return after_header(lines)
    several = re.search(r"[,;\t ]", STAMP.sub("", lines[-1][1]).strip())
    return [(number, STAMP.sub("" if several else r"\1\t", text, count=1)) for number, text in lines]


def after_header(lines: list[Line]) -> list[Line]:
    """The lines after the last end of a header that a file marks as such."""
    ends = [k for k, (_, text) in enumerate(lines[:MOST]) if text.startswith(HEADER_ENDS)]
    if not ends:
        return lines
    rest = lines[ends[-1] + 1 :]
    if rest and rest[0][1].rstrip().endswith("Comment"):
        rest[0] = (rest[0][0], rest[0][1].rstrip().removesuffix("Comment").rstrip())
    return rest
