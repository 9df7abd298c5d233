"""From a measured file to ks and kd: what the command line does, step by step."""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import sys
import tempfile
import time
from typing import Any

import numpy as np

from jeuler._core.files import write_text
from jeuler.commands import options
from jeuler.commands.cautions import cautions
from jeuler.commands.estimate import Estimate, estimate, guess_of, step_size
from jeuler.commands.linear_start import band_limited, without_drift
from jeuler.commands.model import Model
from jeuler.commands.outputs import STANDARD_OUTPUT, check_kind, check_outputs
from jeuler.commands.page import page
from jeuler.commands.picture import draw
from jeuler.commands.report import compared, lines, report
from jeuler.commands.selection import Measurement, recordings_in, select, together
from jeuler.fitting.oscillation import Oscillation

DEFAULT_PICTURE = "jeuler_fit.png"
MOST_DRIFT = 6
NEED_A_FILE = ("columns", "observe", "input", "support", "dim", "time", "run", "unit", "skip", "begin", "end")


def fit_file(arguments: argparse.Namespace, started: float) -> None:
    """Read, fit, print, draw."""
    picture = DEFAULT_PICTURE if arguments.plot is None else arguments.plot
    check_outputs(arguments.files, {"--plot": picture, "--json": arguments.json, "--report": arguments.report})
    check_kind(picture)
    for option in ("begin", "end"):
        options.check_number({"begin": "--from", "end": "--to"}[option], getattr(arguments, option))
    options.check_number("--dt", arguments.dt, positive=True)
    if arguments.max_iterations < 1:
        raise ValueError(f"--max-iterations must be 1 or more, got {arguments.max_iterations}")
    if arguments.drift is not None and not 1 <= arguments.drift <= MOST_DRIFT:
        raise ValueError(f"--drift must be a degree from 1 to {MOST_DRIFT}, got {arguments.drift}")
    measured = _measured(arguments)
    guess = guess_of(without_drift(measured, arguments.drift or 0))
    mass = options.masses(
        arguments.mass if arguments.files else str(options.EXAMPLE["mass"]), measured.positions.shape[1]
    )
    model = _model(arguments, measured, mass, guess)
    dt = step_size(measured, guess, arguments.dt)
    found, compared = _fit(arguments, model, measured, guess, dt)
    warnings = cautions(measured, found, guess, arguments.mass is not None or not arguments.files)
    result = report(measured, found, warnings)
    if compared:
        result["comparison"] = compared
    _write_outputs(arguments, measured, found, picture, result, started)


def _measured(arguments: argparse.Namespace) -> Measurement:
    """The built-in example, one recording, or several of one spring."""
    if not arguments.files:
        given = [name for name in NEED_A_FILE if getattr(arguments, name) is not None]
        if given:
            option = {"begin": "from", "end": "to"}.get(given[0], given[0])
            raise ValueError(f"--{option} has no meaning without a FILE: the built-in example is fitted then")
        return options.example()
    if len({os.path.realpath(file) for file in arguments.files}) < len(arguments.files):
        raise ValueError(
            f"each recording must be given once, got {' '.join(arguments.files)}; --run all takes all runs"
        )
    chosen = [select(recordings_in(_input(file), arguments), arguments) for file in arguments.files]
    return chosen[0] if len(chosen) == 1 else together(chosen)


def _input(file: str) -> Any:
    return sys.stdin.buffer if file == STANDARD_OUTPUT else file


def _model(arguments: argparse.Namespace, measured: Measurement, mass: np.ndarray, guess: Oscillation) -> Model:
    """What the options ask for."""
    particles, dim = measured.positions.shape[1:]
    missing = ~np.isfinite(measured.positions).any(axis=(0, 2))
    if missing.any():
        raise ValueError(f"{measured.source}: a particle without any position; leave it out with --columns")
    pairs, anchored = options.edges(arguments.edges, particles)
    loose = set(range(particles)) - set(anchored) - {k for pair in pairs for k in pair}
    if loose:
        raise ValueError(f"--edges joins no spring to particle {min(loose) + 1}; leave it out with --columns")
    friction = options.frictions(None if arguments.friction == "compare" else arguments.friction)
    if arguments.drag and "quadratic" not in friction:
        friction = (*friction, "quadratic")
    shared = measured.recordings > 1
    if (shared or arguments.pendulum) and arguments.edges is not None:
        raise ValueError("--edges has no meaning with --pendulum or several recordings of one spring")
    if arguments.pendulum and (dim > 1 or (particles > 1 and not shared)):
        raise ValueError(
            f"--pendulum fits one angle, got {particles} particles of {dim} coordinates; choose with --columns"
        )
    if (arguments.cubic or measured.drive is not None) and (particles > 1 or dim > 1 or arguments.pendulum):
        raise ValueError(
            "--cubic, --input and --support fit one particle along one coordinate on a spring; choose with --columns"
        )
    delay = _delay(arguments, measured, pairs)
    unknown = bool(np.isnan(delay).any()) and measured.drive is None
    period = 2 * np.pi / guess.angular_frequency
    speed = float(np.nanstd(measured.positions)) * guess.angular_frequency * np.sqrt(2)
    speed = {"acceleration": speed / guess.angular_frequency**2}.get(
        measured.quantity, speed / guess.angular_frequency if "velocity" in measured.quantity else speed
    )
    return Model(
        mass=mass,
        pairs=tuple(pairs),
        anchored=tuple(anchored),
        dim=dim,
        friction=friction,
        observe=measured.quantity,
        pendulum=arguments.pendulum,
        cubic=arguments.cubic,
        drive=_band_limited_drive(measured),
        moves_support=measured.moves_support,
        delay=delay,
        reach=float(np.nanmax(np.abs([0.0, *delay]))) + 0.75 * period * unknown if measured.drive is None else 0.0,
        drift=arguments.drift or 0,
        span=(float(measured.times[0]), float(measured.times[-1])),
        shared=shared,
        spring_mass=shared and len(set(mass.tolist())) > 1,
        slow=0.02 * speed,
    )


def _delay(arguments: argparse.Namespace, measured: Measurement, pairs: list[tuple[int, int]]) -> tuple[float, ...]:
    """The delays that are asked for, refused where a delay changes nothing but a phase that is free anyway."""
    particles = measured.positions.shape[1]
    if arguments.delay is not None and measured.drive is None and not pairs:
        raise ValueError(
            "--delay: a particle on a spring of its own may start at any phase, so that a delay cannot be told "
            "from it; it shows between particles that springs join (--edges 1-anchor,1-2) and with --input or --support"
        )
    return options.delays(arguments.delay, particles, measured.drive is not None)


def _band_limited_drive(measured: Measurement) -> tuple[np.ndarray, float, float] | None:
    """The measured input on a finer clock; the position of a support about its mean."""
    if measured.drive is None:
        return None
    return band_limited(measured.times, measured.drive - (measured.drive.mean() if measured.moves_support else 0.0))


def _fit(
    arguments: argparse.Namespace, model: Model, measured: Measurement, guess: Oscillation, dt: float
) -> tuple[Estimate, list[dict[str, Any]]]:
    """The fit, or with ``--friction compare`` the best of the friction laws by the Bayesian information criterion.

    A law of two parts begins where the better of these ended.
    """
    asked = options.start(arguments.start)
    if arguments.friction != "compare":
        return estimate(model, measured, guess, dt, asked, arguments.max_iterations), []
    kinds = [("viscous",), ("quadratic",), ("dry",), ("viscous", "dry"), ("viscous", "quadratic"), ("quadratic", "dry")]
    tried: list[Estimate] = []
    for kind in kinds:
        parts = [tried[kinds.index((part,))] for part in kind if len(kind) > 1]
        simpler = min(parts, key=lambda found: found.loss, default=None)
        own = dataclasses.replace(model, friction=kind)
        tried.append(estimate(own, measured, guess, dt, asked, arguments.max_iterations, simpler))
    samples = int(np.isfinite(measured.positions).sum())
    scores = []
    for found in tried:
        size = sum(np.size(x) for x in found.params.values())
        independent = samples / max(min(t.widening for t in tried), 1.0) ** 2
        scores.append(independent * np.log(max(found.loss, 1e-300)) + size * np.log(independent))
    best = int(np.argmin(scores))
    compared = [
        {"friction": "+".join(kind), "rms": float(np.sqrt(found.loss)), "score": float(score - scores[best])}
        for kind, found, score in zip(kinds, tried, scores, strict=True)
    ]
    return tried[best], compared


def _write_outputs(
    arguments: argparse.Namespace,
    measured: Measurement,
    found: Estimate,
    picture: str,
    result: dict[str, Any],
    started: float,
) -> None:
    """Write picture, report, JSON and text; where one goes to standard output, the text goes to standard error."""
    if picture == STANDARD_OUTPUT:
        with tempfile.TemporaryDirectory() as folder:
            path = os.path.join(folder, "fit.png")
            draw(measured, found, path, result)
            with open(path, "rb") as file:
                sys.stdout.buffer.write(file.read())
    else:
        draw(measured, found, picture, result)
    if arguments.report == STANDARD_OUTPUT:
        sys.stdout.write(page(measured, found, result).html())
    elif arguments.report is not None:
        page(measured, found, result).write(arguments.report)
    result["seconds"] = time.perf_counter() - started
    if arguments.json is not None:
        text = json.dumps(result, indent=2) + "\n"
        if arguments.json == STANDARD_OUTPUT:
            sys.stdout.write(text)
        else:
            write_text(arguments.json, text)
    piped = STANDARD_OUTPUT in (picture, arguments.json, arguments.report)
    where = None if picture == STANDARD_OUTPUT else picture
    printed = lines(result, where, example=not arguments.files)
    frictions = [f"  {name:<28} {words}" for name, words in compared(result)]
    print("\n".join(printed + frictions), file=sys.stderr if piped else sys.stdout)
