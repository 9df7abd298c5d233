"""Measured trajectories, as phones, cameras, loggers and spreadsheets export them."""

from __future__ import annotations

import warnings
from typing import Any, NamedTuple

import numpy as np

from jeuler._core.arguments import says_what_to_write
from jeuler._core.describe import object_table, summary
from jeuler.fitting.recordings.reading import read_table
from jeuler.fitting.recordings.recording import Recording, longest, understand
from jeuler.fitting.recordings.table import listed


class Trajectory(NamedTuple):
    """Times and columns of a file.

    Attributes:
      times: the time column, (row,), as the file has it.
      columns: the columns of the same run by name, in the file's order, (row,) each; NaN = missing cell.
    Example:
      >>> import numpy as np, jeuler
      >>> swing = jeuler.Trajectory(np.array([0.0, 0.1]), {"x": np.array([1.0, 0.9])})
      >>> times, columns = swing
      >>> columns["x"].tolist()
      [1.0, 0.9]
    """

    times: np.ndarray
    columns: dict[str, np.ndarray]

    def __repr__(self) -> str:
        return summary(self)

    def _repr_html_(self) -> str:
        return object_table(self)


@says_what_to_write()
def read_trajectory(
    path: Any, *, time: str | None = None, run: str | int | None = None, si: bool = False, skip: int = 0
) -> Trajectory:
    """Read times and columns from a recording as it was exported.

    Text with commas, semicolons, tabs or blanks between cells, decimal points or commas, in UTF-8, UTF-16 or Latin-1;
    title lines, names (in a comment too), a row of units; empty cells, NA, #N/A and the like are missing; dates and
    times of day become seconds. Runs side by side (each with a time column) and stacked (the clock starts again) are
    told apart. Markers of motion capture (``.trc``), MATLAB files by scipy; Excel workbooks by pandas and xlrd, and
    ``.c3d`` by the library c3d (``pip install 'jeuler[io]'``).

    Args:
      path: a path, an open file, or a pandas or polars frame. A ``.gz`` file, or a zip file of one table, is unpacked.
      time: name of the time column; None takes the one that is named as a time, or else the first.
      run: which run, "1", "2", ...; None takes the longest.
      si: convert to seconds, metres, m/s^2, radians by the units in the names. False leaves numbers as the file has
        them and warns where they are in other units.
      skip: how many lines at the top of a text to leave out.
    Returns: `Trajectory`, ``times`` and ``columns``, float64.
    Raises: ValueError, one line with file, line and column, for what cannot be read; OSError, if there is no file.
    Example:
      >>> import pathlib, tempfile, jeuler
      >>> path = pathlib.Path(tempfile.mkdtemp()) / "swing.csv"
      >>> _ = path.write_text("time (ms);x (mm)\\n0,0;1,5\\n100,0;\\n")
      >>> times, columns = jeuler.read_trajectory(path, si=True)
      >>> times.tolist(), columns["x (mm)"].tolist()
      ([0.0, 0.1], [0.0015, nan])

    Source: RFC 4180 for quotes.
    """
    table = read_table(path, skip)
    recordings = understand(table, time, ordered=False)
    recording = chosen_run(recordings, None if run is None else str(run))
    others = [other.run for other in recordings if other is not recording]
    if others and run is None:
        warnings.warn(
            f"{table.source}: {len(recordings)} runs; run {recording.run} with the most rows was read, "
            f"run={others[0]!r} reads another",
            stacklevel=2,
        )
    kept = [(k, column) for k, column in enumerate(recording.columns) if column.quantity != "text"]
    if si:
        return Trajectory(recording.times, {column.name: recording.values[:, k] for k, column in kept})
    clock = recording.clock
    foreign = [column.name for column in (clock, *(column for _, column in kept)) if abs(column.factor - 1) > 0]
    if foreign:
        warnings.warn(
            f"{table.source}: {listed(foreign)}: numbers are in the units of the file; "
            f"si=True converts them to s, m, m/s^2, rad",
            stacklevel=2,
        )
    begin, end = recording.rows
    times = recording.times if clock.unit == "date" else table.values[begin:end, clock.index]
    return Trajectory(times, {column.name: table.values[begin:end, column.index] for _, column in kept})


def chosen_run(recordings: list[Recording], run: str | None) -> Recording:
    """The run of that label, the longest for None."""
    if run is None:
        return longest(recordings)
    for recording in recordings:
        if recording.run == run.strip().removeprefix("#"):
            return recording
    raise ValueError(
        f"{recordings[0].source}: no run {run!r}, there are {', '.join(recording.run for recording in recordings[:20])}"
    )
