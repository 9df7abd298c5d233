"""From a file of tracks to the springs between them: ``python -m jeuler find``."""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from typing import Any

import numpy as np

from jeuler._core.files import write_atomically, write_text
from jeuler.commands import options
from jeuler.commands.outputs import STANDARD_OUTPUT, check_kind, check_outputs
from jeuler.commands.selection import Measurement, recordings_in, select
from jeuler.fitting import FoundSprings, find_springs
from jeuler.forces import Gravity

DEFAULT_PICTURE = "jeuler_find.png"
MOST_PRINTED = 40


def find_file(arguments: argparse.Namespace) -> None:
    """Read, find, print, draw."""
    picture = DEFAULT_PICTURE if arguments.plot is None else arguments.plot
    check_outputs([arguments.file], {"--plot": picture, "--json": arguments.json})
    check_kind(picture)
    options.check_number("--from", arguments.begin)
    options.check_number("--to", arguments.end)
    options.check_number("--sigma", arguments.sigma, positive=True)
    source = sys.stdin.buffer if arguments.file == STANDARD_OUTPUT else arguments.file
    measured = select(recordings_in(source, arguments), arguments)
    particles, dim = measured.positions.shape[1:]
    if measured.quantity != "position" or particles < 2:
        raise ValueError(
            f"{measured.source}: springs are found between the positions of two particles or more, got {particles} of "
            f"{measured.quantity}; choose with --columns and --dim"
        )
    gravity = options.vector("--gravity", arguments.gravity, dim)
    found = find_springs(
        measured.times,
        measured.positions,
        mass=options.known_masses(arguments.mass, particles),
        forces=() if gravity is None else (Gravity(gravity),),
        sigma=arguments.sigma,
    )
    result = summary(measured, found, gravity)
    if arguments.mass is None:
        result["warnings"].append(
            "The masses are taken to be 1 kg each: with others, ks and kd are other ones; --mass."
        )
    _write(arguments, picture, found, result)


def summary(measured: Measurement, found: FoundSprings, gravity: np.ndarray | None) -> dict[str, Any]:
    """What was found, as JSON; particles count from 1."""
    springs = [
        {
            "particles": [int(a) + 1, int(b) + 1],
            **{name: float(getattr(found, name)[k]) for name in ("ks", "kd", "rest_length")},
            "stderr": {name: _number(errors[k]) for name, errors in found.stderr.items()},
            "significance": float(found.significance[k]),
        }
        for k, (a, b) in enumerate(found.edges)
    ]
    warnings = list(measured.warnings)
    if gravity is None and measured.positions.shape[2] > 1 and not np.isfinite(found.state.mass).all():
        warnings.append("No gravity was given: if it acts along one of the coordinates, say so, --gravity 0,-9.81.")
    return {
        "source": measured.source,
        "particles": [", ".join(names) for names in _names(measured)],
        "mass": [_number(m) for m in np.broadcast_to(np.asarray(found.state.mass, float), measured.positions.shape[1])],
        "springs": springs,
        "hidden": (found.hidden + 1).tolist(),
        "explained": bool(found.explained),
        "sigma": float(found.sigma),
        "message": found.message,
        "notes": list(measured.notes),
        "warnings": warnings,
    }


def _names(measured: Measurement) -> list[list[str]]:
    dim = measured.positions.shape[2]
    return [measured.names[k : k + dim] for k in range(0, len(measured.names), dim)]


def _number(x: Any) -> float | None:
    """A number as JSON has it; None for infinity."""
    return float(x) if np.isfinite(x) else None


def lines(result: dict[str, Any], picture: str | None) -> list[str]:
    """What is printed."""
    springs = result["springs"]
    unexplained = "" if result["explained"] else ", which do not explain the motion"
    text = [f"{result['source']}: {len(springs)} springs between {len(result['particles'])} particles{unexplained}"]
    if springs:
        text.append(f"  {'':<9} {'ks [N/m]':>22} {'kd [N s/m]':>22} {'rest length [m]':>22}")
    for spring in springs[:MOST_PRINTED]:
        values = [_with_error(spring[name], spring["stderr"].get(name)) for name in ("ks", "kd", "rest_length")]
        name = "-".join(map(str, spring["particles"]))
        text.append(f"  {name:<9} {values[0]:>22} {values[1]:>22} {values[2]:>22}")
    if len(springs) > MOST_PRINTED:
        text.append(f"  and {len(springs) - MOST_PRINTED} more, all of them with --json")
    text += [f"  {part}" for part in result["message"].split("; ")]
    text += [f"  {note}" for note in result["notes"]] + [f"  WARNING {warning}" for warning in result["warnings"]]
    return text if picture is None else [*text, f"  picture: {picture}"]


def _with_error(value: float, error: float | None) -> str:
    return f"{value:.5g}" if error is None else f"{value:.5g} ± {error:.2g}"


def draw(found: FoundSprings, path: str, kind: str, title: str) -> None:
    """The net at the first time, each spring in the colour of its ks."""
    import matplotlib.pyplot as plt

    from jeuler.plotting.fits import plain_text
    from jeuler.plotting.residuals import plot_net

    position = np.asarray(found.state.position, float)
    pinned = np.isinf(np.broadcast_to(np.asarray(found.state.mass), len(position)))
    figure = plot_net(position, found.edges.reshape(-1, 2), found.ks, label="ks [N/m]", pinned=pinned)
    figure.axes[0].set_title(plain_text(title))
    figure.savefig(path, dpi=130, format=kind)
    plt.close(figure)


def _write(arguments: argparse.Namespace, picture: str, found: FoundSprings, result: dict[str, Any]) -> None:
    """Picture, JSON and text; where one goes to standard output, the text goes to standard error."""
    title = f"{os.path.basename(result['source'])}: {len(result['springs'])} springs"
    if picture == STANDARD_OUTPUT:
        with tempfile.TemporaryDirectory() as folder:
            path = os.path.join(folder, "find.png")
            draw(found, path, "png", title)
            with open(path, "rb") as file:
                sys.stdout.buffer.write(file.read())
    else:
        kind = os.path.splitext(os.path.realpath(picture))[1][1:].lower() or "png"
        write_atomically(picture, lambda path: draw(found, path, kind, title))
    if arguments.json == STANDARD_OUTPUT:
        sys.stdout.write(json.dumps(result, indent=2) + "\n")
    elif arguments.json is not None:
        write_text(arguments.json, json.dumps(result, indent=2) + "\n")
    piped = STANDARD_OUTPUT in (picture, arguments.json)
    printed = lines(result, None if picture == STANDARD_OUTPUT else picture)
    print("\n".join(printed), file=sys.stderr if piped else sys.stdout)
