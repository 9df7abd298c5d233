"""What is fitted: the run, the columns and the span of a recording, by the options or else by names and units."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from jeuler.commands.channels import OBSERVED, choose_columns, input_column, resolve
from jeuler.fitting.oscillation import estimate_oscillation
from jeuler.fitting.recordings.clock import Sampling, sampling
from jeuler.fitting.recordings.columns import Column
from jeuler.fitting.recordings.reading import read_table
from jeuler.fitting.recordings.recording import Recording, longest, understand
from jeuler.fitting.recordings.table import counted, listed
from jeuler.fitting.spectrum import block_means, strong_lines
from jeuler.fitting.trajectory import chosen_run

LEAST_ROWS = 5
SPANS = 1e-12, 1e12  # s
SMALLEST = 1e-30
THIN_ABOVE = 20_000  # rows
SAMPLES_A_PERIOD = 40
UNITS = {"position": "m", "angle": "rad", "acceleration": "m/s^2", "velocity": "m/s", "angular velocity": "rad/s"}


@dataclasses.dataclass(frozen=True)
class Measurement:
    """What is fitted.

    Attributes:
      source: the file.  run: its label, "" where the file has only one.  clock: the name of the time column.
      times: (time,), s.  positions: values of the observed quantity, (time, particle, dim), in `unit`.
      names: (particle * dim,).  quantity, unit: of the values.  left_out: (name, reason) of the other columns.
      notes: what was done, as sentences.  warnings: what may be wrong, as sentences with what to do.
      sampling: the clock before thinning.  recordings: how many of them are fitted together, one a particle.
      drive: a measured force at the times, (time,), with --input; the support's position, with --support.
      moves_support: whether drive is the latter.
    """

    source: str
    run: str
    clock: str
    times: np.ndarray
    positions: np.ndarray
    names: list[str]
    quantity: str = "position"
    unit: str = "m"
    left_out: tuple[tuple[str, str], ...] = ()
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    sampling: Sampling | None = None
    recordings: int = 1
    drive: np.ndarray | None = None
    moves_support: bool = False


def recordings_in(source: Any, arguments: Any) -> list[Recording]:
    """The runs in a file, understood with the corrections that the options make."""
    table = read_table(source, arguments.skip or 0)
    return understand(table, arguments.time, _units(arguments.unit, table.names))


def _units(text: str | None, names: list[str]) -> dict[str, str]:
    """``x=mm,t=ms`` as units by column name."""
    units = {}
    for part in text.split(",") if text else []:
        name, equals, unit = part.rpartition("=")
        found = resolve(name.strip(), names) if equals else None
        if found is None or not unit.strip():
            raise ValueError(
                f"--unit must be like x=mm,t=ms with names of columns, got {part.strip()!r}; "
                f"the columns are {listed(names)}"
            )
        if found in units:
            raise ValueError(f"--unit must name each column once, got {found!r} twice in {text!r}")
        units[found] = unit.strip()
    return units


def select(recordings: list[Recording], arguments: Any) -> Measurement:
    """The run, columns and span to be fitted."""
    if arguments.run == "all":
        return together([_one(recording, arguments) for recording in recordings])
    recording = longest(recordings) if arguments.run is None else chosen_run(recordings, arguments.run)
    measured = _one(recording, arguments)
    others = [f"{r.run} ({len(r.times)} rows)" for r in recordings if r is not recording]
    if not others:
        return dataclasses.replace(measured, run="")
    note = f"Run {recording.run} of {len(recordings)} is used; the others are {listed(others)}: --run N or --run all."
    return dataclasses.replace(measured, notes=(*measured.notes, note))


def _one(recording: Recording, arguments: Any) -> Measurement:
    columns, quantity, dim, left_out = choose_columns(recording, arguments)
    keep = _rows_kept(recording, arguments)
    values = recording.values[:, [recording.columns.index(column) for column in columns]][keep]
    _check_sizes(recording, columns, values)
    warnings = [*_unit_words(columns), *_size_words(columns, quantity, values)]
    unknown = any(np.isnan(column.factor) for column in columns)
    alike = [column for column in columns if column.quantity and column.quantity not in OBSERVED]
    unit = columns[0].unit if unknown else columns[0].si if alike else UNITS[quantity]
    notes = recording.notes
    if alike:
        notes = (
            *notes,
            f"{listed([c.name for c in alike])}: a {alike[0].quantity}, fitted as if it were a position, whose "
            f"frequency and decay it has: ks and kd are right, amplitudes are in {unit or 'its own unit'}.",
        )
    measured = Measurement(
        drive=_drive(recording, arguments, columns, keep),
        moves_support=arguments.support is not None,
        source=recording.source,
        run=recording.run,
        clock=recording.clock.name,
        times=recording.times[keep],
        positions=values.reshape(len(values), -1, dim),
        names=[column.name for column in columns],
        quantity=quantity,
        unit=unit,
        left_out=(*recording.left_out, *left_out),
        notes=notes,
        warnings=(*recording.warnings, *warnings),
    )
    clock = sampling(measured.times)
    driven: tuple[str, ...] = ()
    if measured.drive is not None:
        driven = (f"{arguments.input} is the measured force u(t).",)
        if arguments.support is not None:
            driven = (f"{arguments.support} is the measured position s(t) of the support.",)
    gaps = (
        (f"The record has {counted(clock.gaps, 'gap')}, the longest of {clock.longest_gap:.3g} s.",)
        if clock.gaps
        else ()
    )
    return thinned(dataclasses.replace(measured, sampling=clock, notes=(*measured.notes, *driven, *gaps)))


def _rows_kept(recording: Recording, arguments: Any) -> np.ndarray:
    """Which rows are between --from and --to: enough of them, over a time that can be one in seconds."""
    begin, end, times = arguments.begin, arguments.end, recording.times
    keep = np.ones(len(times), bool)
    keep &= times >= begin if begin is not None else True
    keep &= times <= end if end is not None else True
    if keep.sum() < LEAST_ROWS:
        raise ValueError(
            f"{recording.source}: {keep.sum()} rows{' between --from and --to' if not keep.all() else ''}, expected "
            f"{LEAST_ROWS} at least; the times run from {times.min():g} to {times.max():g} s"
        )
    span = float(np.ptp(times[keep]))
    if not SPANS[0] < span < SPANS[1]:
        raise ValueError(
            f"{recording.source}: column {recording.clock.index + 1} ({recording.clock.name[:60]}): the times span "
            f"{span:g} s, expected {SPANS[0]:g} to {SPANS[1]:g} s; say which column is the time with --time, and its "
            f"unit with --unit"
        )
    return keep


def _check_sizes(recording: Recording, columns: list[Column], values: np.ndarray) -> None:
    """No column moves by less than a number in SI units can tell from nothing."""
    for column, given in zip(columns, values.T, strict=True):
        seen = given[np.isfinite(given)]
        if len(seen) and 0 < np.ptp(seen) < SMALLEST:
            raise ValueError(
                f"{recording.source}: column {column.index + 1} ({column.name[:60]}): moves by {np.ptp(seen):g} "
                f"{column.si}, less than can be told from nothing; say its unit with --unit"
            )


def _unit_words(columns: list[Column]) -> list[str]:
    """Warnings where a unit has no known scale, or nothing says what a column is."""
    words = []
    unknown = [column.name for column in columns if np.isnan(column.factor)]
    if unknown:
        words.append(
            f"The unit of {listed(unknown)} has no known scale: positions are in {columns[0].unit}; "
            f"ks and kd are right, as they do not depend on it, but forces and amplitudes are not in SI units."
        )
    untold = [column.name for column in columns if not column.told]
    if untold:
        words.append(
            f"Neither name nor unit says what {listed(untold)} is: taken as a position in m. "
            f"Correct it with --observe or --unit."
        )
    return words


def _size_words(columns: list[Column], quantity: str, values: np.ndarray) -> list[str]:
    """A warning where no unit is given and the numbers are larger than is usual for such a motion."""
    usual = {"position": 2.0, "angle": 4 * np.pi}.get(quantity, np.inf)
    extent = float(np.nanmax(np.nanmax(values, axis=0) - np.nanmin(values, axis=0)))
    if any(column.unit for column in columns) or extent <= usual:
        return []
    others = "another unit or an acceleration" if quantity == "position" else "degrees"
    name = columns[0].name
    return [
        f"{listed([c.name for c in columns])}: no unit, and an extent of {extent:.3g}: taken to be in "
        f"{UNITS[quantity]}. "
        f"If it is {others}, give --unit, such as --unit {name}={'m/s^2' if quantity == 'position' else 'deg'}."
    ]


def thinned(measured: Measurement) -> Measurement:
    """The recording with blocks of rows averaged to one, where it has far more rows than the motion needs."""
    rows = len(measured.times)
    if rows <= THIN_ABOVE or measured.drive is not None:
        return measured
    flat = measured.positions.reshape(rows, -1)
    try:
        slowest = estimate_oscillation(measured.times, flat).angular_frequency
    except ValueError as error:
        raise ValueError(f"{measured.source}: {error}") from None
    lines = [omega for column in flat.T for omega, _ in strong_lines(measured.times, column)]
    period = 2 * np.pi / max([slowest, *lines])
    block = int(min(rows / THIN_ABOVE, period / SAMPLES_A_PERIOD / (np.ptp(measured.times) / rows)))
    if block < 2:
        return measured
    times = block_means(measured.times, block)
    per_period = rows / np.ptp(measured.times) * period
    note = f"Of {rows} rows every {block} are averaged to one: there were {per_period:.0f} a period."
    return dataclasses.replace(
        measured,
        times=times,
        positions=block_means(measured.positions, block),
        notes=(*measured.notes, note),
    )


def together(measured: list[Measurement]) -> Measurement:
    """Several recordings as one, each a particle, with every clock starting at its first row."""
    first = measured[0]
    for other in measured[1:]:
        if (other.quantity, other.positions.shape[1:]) != (first.quantity, first.positions.shape[1:]):
            raise ValueError(
                f"recordings fitted together must hold the same: {first.source} has {first.quantity} of shape "
                f"{first.positions.shape[1:]}, {other.source} {other.quantity} of {other.positions.shape[1:]}"
            )
    if first.positions.shape[1] != 1:
        raise ValueError(f"recordings fitted together must hold one particle each, got {first.positions.shape[1]}")
    clocks = [m.times - m.times[0] for m in measured]
    times = np.unique(np.concatenate(clocks))
    positions = np.full((len(times), len(measured), first.positions.shape[2]), np.nan)
    for k, (clock, m) in enumerate(zip(clocks, measured, strict=True)):
        positions[np.searchsorted(times, clock), k] = m.positions[:, 0]
    sources = list(dict.fromkeys(m.source for m in measured))
    return dataclasses.replace(
        first,
        source=", ".join(sources),
        run=", ".join(m.run for m in measured if m.run),
        times=times,
        positions=positions,
        names=[name for m in measured for name in m.names],
        left_out=tuple(dict.fromkeys(pair for m in measured for pair in m.left_out)),
        notes=tuple(dict.fromkeys(note for m in measured for note in m.notes)),
        warnings=tuple(dict.fromkeys(warning for m in measured for warning in m.warnings)),
        sampling=sampling(times),
        recordings=len(measured),
    )


def _drive(recording: Recording, arguments: Any, columns: list[Column], keep: np.ndarray) -> np.ndarray | None:
    """The measured force or position of the support, checked; None without."""
    if arguments.input is None and arguments.support is None:
        return None
    if arguments.input is not None and arguments.support is not None:
        raise ValueError("--input and --support cannot both be given; a fit has one measured input")
    column = input_column(recording, arguments)
    about = f"{recording.source}: {'--input' if arguments.support is None else '--support'} {column.name}"
    drive = recording.values[:, recording.columns.index(column)][keep]
    if not np.isfinite(drive).all():
        raise ValueError(
            f"{about}: {np.isnan(drive).sum()} values are missing; a measured input must have none missing"
        )
    if not np.ptp(drive):
        raise ValueError(f"{about}: all values are {drive[0]:g}; leave the option out where nothing drives the motion")
    clock = sampling(recording.times[keep])
    if clock.gaps or clock.repeated or clock.jitter > 0.02:
        raise ValueError(f"{about}: its clock must be even to be interpolated: {clock.words()}")
    if arguments.support is not None and np.isnan(column.factor) != np.isnan(columns[0].factor):
        raise ValueError(
            f"{about}: is in {column.si or 'an unknown unit'} and {columns[0].name} in {columns[0].si}; "
            f"both must have one unit: say it with --unit"
        )
    return drive
