"""One door for all kinds of source: `read_table`."""

from __future__ import annotations

from typing import Any

from jeuler._core import checks
from jeuler.fitting.recordings import source as sources
from jeuler.fitting.recordings.frames import is_frame, read_frame, read_matlab, read_workbook
from jeuler.fitting.recordings.motion_capture import is_c3d, is_trc, read_c3d, read_trc
from jeuler.fitting.recordings.table import Table
from jeuler.fitting.recordings.text import read_text


def read_table(source: Any, skip: int = 0) -> Table:
    """The table in a path, an open file or a frame; ``skip``: how many lines at the top of a text to leave out."""
    skip = checks.count("skip", skip)
    if is_frame(source):
        return read_frame(source)
    name, raw = sources.content(source)
    if isinstance(raw, bytes) and sources.is_workbook(raw):
        return read_workbook(name, raw, skip)
    if isinstance(raw, bytes) and raw.startswith(b"MATLAB"):
        return read_matlab(name, raw)
    if isinstance(raw, bytes) and is_c3d(raw):
        return read_c3d(name, raw)
    decoded, notes = sources.text(name, raw)
    if is_trc(decoded):
        return read_trc(name, decoded, notes)
    return read_text(name, decoded, skip, notes)
