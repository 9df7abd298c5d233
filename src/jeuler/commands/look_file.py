"""What is understood of a recording, before anything is fitted."""

from __future__ import annotations

import argparse
import shlex

import numpy as np

from jeuler.commands import options
from jeuler.commands.channels import OBSERVED
from jeuler.commands.selection import Measurement, recordings_in, select
from jeuler.fitting.recordings.columns import Column
from jeuler.fitting.recordings.recording import Recording
from jeuler.fitting.recordings.table import listed
from jeuler.fitting.spectrum import strong_lines

WIDTH, HEIGHT = 72, 9
MOST_COLUMNS = 60


def look_file(arguments: argparse.Namespace) -> None:
    """Read, understand, print."""
    options.check_number("--from", arguments.begin)
    options.check_number("--to", arguments.end)
    recordings = recordings_in(arguments.file, arguments)
    print(f"{arguments.file}: {len(recordings)} run{'s' if len(recordings) > 1 else ''}")
    for note in recordings[0].notes:
        print(f"  {note}")
    for recording in recordings[:20]:
        print(f"run {recording.run}: {recording.sampling.words()}")
        print(f"  {'time':<24} {recording.clock.name} [{recording.clock.unit or 's, as no unit is given'}]")
        for k, column in enumerate(recording.columns[:MOST_COLUMNS]):
            print(f"  {column.name[:40]:<24} {_words(column, recording.values[:, k])}")
        if len(recording.columns) > MOST_COLUMNS:
            print(f"  and {len(recording.columns) - MOST_COLUMNS} more columns")
        for name, reason in recording.left_out:
            print(f"  {name[:40]:<24} left out: {reason}")
    if len(recordings) > 20:
        print(f"and {len(recordings) - 20} more runs")
    measured = select(recordings, arguments)
    print("\n".join(_chosen(measured)))
    for warning in measured.warnings:
        print(f"  WARNING {warning}")
    print("to fit it:")
    print(f"  {suggested(arguments, measured, recordings)}")


def _words(column: Column, values: np.ndarray) -> str:
    """A column in one line."""
    if column.quantity == "text":
        return "text"
    seen = values[np.isfinite(values)]
    if not len(seen):
        return f"{column.quantity or 'unknown'}, no values"
    missing = len(values) - len(seen)
    ranged = f"{seen.min():.5g} to {seen.max():.5g} {column.si}".rstrip()
    converted = (
        f" (from {column.unit})" if column.unit and column.factor not in (1.0,) and column.si != column.unit else ""
    )
    axis = f" along {column.axis}" if column.axis and column.quantity in OBSERVED else ""
    gaps = f", {missing} missing" if missing else ""
    return f"{column.quantity or 'unknown quantity'}{axis}, {ranged}{converted}{gaps}"


def _chosen(measured: Measurement) -> list[str]:
    """What would be fitted: columns, dominant frequencies, a small picture."""
    text = [f"would be fitted: {measured.quantity} {listed(measured.names)} in {measured.unit}"]
    for name, reason in measured.left_out:
        text.append(f"  {name[:40]:<24} left out: {reason}")
    flat = measured.positions.reshape(len(measured.times), -1)
    for name, column in zip(measured.names, flat.T, strict=True):
        found = strong_lines(measured.times, column)
        words = ", ".join(
            f"{omega / (2 * np.pi):.4g} Hz ({amplitude:.2g} {measured.unit})" for omega, amplitude in found
        )
        text.append(f"  {name[:40]:<24} oscillates at {words}" if words else f"  {name[:40]:<24} no clear oscillation")
    largest = int(np.nanargmax(np.nanstd(flat, axis=0)))
    return [*text, *small_picture(measured.times, flat[:, largest])]


def small_picture(times: np.ndarray, values: np.ndarray) -> list[str]:
    """A plot in characters: each column of characters spans the least to the largest value in its part of the time."""
    edges = np.linspace(times[0], times[-1], WIDTH + 1)
    place = np.clip(np.searchsorted(edges, times, side="right") - 1, 0, WIDTH - 1)
    low, high = np.nanmin(values), np.nanmax(values)
    span = (high - low) or 1.0
    canvas = [[" "] * WIDTH for _ in range(HEIGHT)]
    for column in range(WIDTH):
        inside = values[place == column]
        inside = inside[np.isfinite(inside)]
        if len(inside):
            top = round((high - inside.max()) / span * (HEIGHT - 1))
            bottom = round((high - inside.min()) / span * (HEIGHT - 1))
            for row in range(top, bottom + 1):
                canvas[row][column] = "*"
    labels = [f"{high:>10.4g}", *[" " * 10] * (HEIGHT - 2), f"{low:>10.4g}"]
    foot = f"{'':>10}  {times[0]:<.4g} s{'':>{WIDTH - 20}}{times[-1]:>.4g} s"
    return [f"{label} |{''.join(row).rstrip()}" for label, row in zip(labels, canvas, strict=True)] + [foot]


def suggested(arguments: argparse.Namespace, measured: Measurement, recordings: list[Recording]) -> str:
    """The fit command, with the options that were given."""
    words = ["python", "-m", "jeuler", "fit", arguments.file]
    for option, name in (
        ("--columns", "columns"),
        ("--observe", "observe"),
        ("--input", "input"),
        ("--support", "support"),
        ("--dim", "dim"),
        ("--time", "time"),
        ("--run", "run"),
        ("--unit", "unit"),
        ("--skip", "skip"),
        ("--from", "begin"),
        ("--to", "end"),
    ):
        value = getattr(arguments, name)
        if value is not None:
            words += [option, f"{value:g}" if isinstance(value, float) else str(value)]
    if len(recordings) > 1 and arguments.run is None:
        words += ["--run", max(recordings, key=lambda r: len(r.times)).run]
    particles = measured.positions.shape[1]
    flat = measured.positions.reshape(len(measured.times), -1)
    if measured.quantity == "angle" and particles == 1 and np.nanmax(np.abs(flat - np.nanmean(flat))) > 0.35:
        words.append("--pendulum")
    shown = shlex.join(words) + " --mass " + ",".join(f"KG{k + 1}" if particles > 1 else "KG" for k in range(particles))
    if particles > 1:
        return shown + "   (springs between the particles: --edges 1-anchor,1-2)"
    return shown
