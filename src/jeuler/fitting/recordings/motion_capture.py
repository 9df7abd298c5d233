"""Recordings of motion capture: marker files of text (.trc) and of bytes (.c3d)."""

from __future__ import annotations

import io
import re
import warnings

import numpy as np

from jeuler.fitting.recordings.table import Table, named
from jeuler.fitting.recordings.text import read_text

AXES = ("x", "y", "z")


def is_trc(text: str) -> bool:
    """Whether a text is a track row column file."""
    return text.startswith("PathFileType")


def is_c3d(raw: bytes) -> bool:
    """Whether bytes are a C3D file: the second is 80, and the first, the block of the parameters, is no letter."""
    return len(raw) >= 512 and raw[1] == 80 and 0 < raw[0] < 32 and chr(raw[0]) not in "\t\n\r"


def read_trc(source: str, text: str, notes: tuple[str, ...] = ()) -> Table:
    """The table of a .trc file: its five lines of header become names with units, "x LKNE (mm)"."""
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    if len(lines) < 6:
        raise ValueError(f"{source}: line {len(lines)}: the header of a .trc file has 5 lines, and data follow")
    about = dict(zip(lines[1].split("\t"), lines[2].split("\t"), strict=False))
    unit = about.get("Units", "").strip()
    labels = [cell.strip() for cell in lines[3].split("\t")]
    if [label.rstrip("#").lower() for label in labels[:2]] != ["frame", "time"]:
        raise ValueError(f"{source}: line 4: expected Frame#, Time and the markers, got {' '.join(labels[:3])[:60]!r}")
    markers = [label for label in labels[2:] if label]
    if not markers:
        raise ValueError(f"{source}: line 4: no marker is named")
    names = ["Frame", "Time (s)", *_coordinates(markers, unit)]
    return read_text(source, "\n".join(["", "", "", "\t".join(names), "", *lines[5:]]), 0, notes)


def read_c3d(source: str, raw: bytes) -> Table:
    """The marker positions of a .c3d file, by the library c3d; points that no camera saw are missing."""
    try:
        import c3d
    except ImportError:
        raise ValueError(f"{source}: a .c3d file needs the library c3d: pip install 'jeuler[io]'") from None
    frames = []
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            reader = c3d.Reader(io.BytesIO(raw))
            labels = [str(label).strip() for label in reader.point_labels][: reader.point_used]
            unit = reader.get("POINT:UNITS")
            rate, expected, analog = float(reader.point_rate), int(reader.frame_count), int(reader.analog_used)
            for _, points, _ in reader.read_frames(copy=False):
                frames.append(np.where(points[:, 3:4] < 0, np.nan, points[:, :3]).ravel())
    except Exception as error:  # the library documents none of what a damaged file makes it raise
        raise ValueError(
            f"{source}: the .c3d file cannot be read ({error or type(error).__name__}); "
            f"copy it again, or export a .trc file"
        ) from None
    if len(frames) < expected or not frames or not frames[0].size or not (np.isfinite(rate) and rate > 0):
        raise ValueError(
            f"{source}: the .c3d file holds {len(frames)} of {expected} frames of {len(labels)} markers "
            f"at {rate:g} Hz; copy it again, or export a .trc file"
        )
    labels += [f"marker{k + 1}" for k in range(len(labels), frames[0].size // 3)]
    names = ["Time (s)", *_coordinates(labels, unit.string_value.strip() if unit else "")]
    values = np.column_stack([np.arange(len(frames)) / rate, np.array(frames, float)])
    notes = (f"{analog} analog channels are not read.",) if analog else ()
    return Table(source, named(names), [""] * len(names), values, notes=notes)


def _coordinates(markers: list[str], unit: str) -> list[str]:
    """The names of the coordinates of markers: "x LKNE (mm)"."""
    plain = [re.sub(r"\W+", "_", marker).strip("_") or f"marker{k + 1}" for k, marker in enumerate(markers)]
    return [f"{axis} {marker}" + (f" ({unit})" if unit else "") for marker in plain for axis in AXES]
