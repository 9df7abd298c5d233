"""What was measured, and what the options of the command line say about it: files and texts to arrays."""

from __future__ import annotations

import argparse
import dataclasses
import re

import numpy as np

from jeuler.fitting.trajectory import read_trajectory

EXAMPLE = {"mass": 0.5, "ks": 20.0, "kd": 0.3, "rest": 0.1, "noise": 0.001}


@dataclasses.dataclass(frozen=True)
class Measurement:
    """Positions of particles over time: times (time,), positions (time, particle, dim), names (particle, dim)."""

    source: str
    times: np.ndarray
    positions: np.ndarray
    names: list[str]


def example() -> Measurement:
    """A damped spring, solved by diffrax to 1e-10 and given noise: data that the fit's own steps did not make."""
    import diffrax
    import jax.numpy as jnp

    def field(t, y, _):
        x, v = y
        force = -EXAMPLE["ks"] * (x - EXAMPLE["rest"]) - EXAMPLE["kd"] * v
        return v, force / EXAMPLE["mass"]

    times = np.linspace(0.0, 8.0, 241)
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(field),
        diffrax.Tsit5(),
        0.0,
        8.0,
        1e-3,
        (jnp.asarray(0.16), jnp.asarray(0.0)),
        saveat=diffrax.SaveAt(ts=jnp.asarray(times)),
        stepsize_controller=diffrax.PIDController(rtol=1e-10, atol=1e-10),
    )
    noise = EXAMPLE["noise"] * np.random.default_rng(7).standard_normal(len(times))
    return Measurement("built-in example", times, (np.asarray(solution.ys[0]) + noise)[:, None, None], ["x"])


def read(arguments: argparse.Namespace) -> Measurement:
    """The file's positions as (time, particle, dim)."""
    times, columns = read_trajectory(arguments.file)
    keep = np.ones(len(times), bool)
    if arguments.begin is not None:
        keep &= times >= arguments.begin
    if arguments.end is not None:
        keep &= times <= arguments.end
    if keep.sum() < 5:
        raise ValueError(
            f"{arguments.file}: {keep.sum()} rows between --from and --to, expected 5 at least; "
            f"the times run from {times.min():g} to {times.max():g} s"
        )
    names, dim = _position_columns(list(columns), arguments)
    values = np.stack([columns[name] for name in names], axis=1)[keep]
    return Measurement(arguments.file, times[keep], values.reshape(len(values), -1, dim), names)


def _position_columns(available: list[str], arguments: argparse.Namespace) -> tuple[list[str], int]:
    """Which columns are positions, particle by particle, and how many coordinates each has."""
    if arguments.columns:
        names = [name.strip() for name in arguments.columns.split(",")]
        unknown = [name for name in names if name not in available]
        if unknown:
            raise ValueError(f"{arguments.file}: no column {unknown[0]!r}, the columns are {', '.join(available)}")
    else:
        names = [name for name in available if re.match(r"[xyz]($|[^a-z])", name.lower())] or available
    axes = [name[0].lower() for name in names]
    # x1 y1 x2 y2: a particle has as many coordinates as there are different letters
    told = len(set(axes)) if set(axes) <= set("xyz") else (len(names) if len(names) <= 3 else 1)
    dim = told if arguments.dim is None else arguments.dim
    if dim < 1 or len(names) % dim:
        raise ValueError(
            f"{arguments.file}: {len(names)} position columns ({', '.join(names)}) do not make particles of "
            f"{dim} coordinates; choose with --columns and --dim"
        )
    if dim > 1 and set(axes) <= set("xyz") and any(len(set(axes[k : k + dim])) < dim for k in range(0, len(axes), dim)):
        particle = [re.sub(r"\D", "", name) for name in names]
        names = [name for _, name in sorted(zip(particle, names, strict=True))]
    return names, dim


def _floats(option: str, text: str) -> list[float]:
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        raise ValueError(f"{option} must be numbers separated by commas, got {text!r}") from None


def masses(text: str, particles: int) -> np.ndarray:
    masses = np.array(_floats("--mass", text))
    if len(masses) not in (1, particles) or not (masses > 0).all() or not np.isfinite(masses).all():
        raise ValueError(f"--mass must be one positive number of kg or {particles}, one a particle, got {text!r}")
    return np.broadcast_to(masses, particles)


def edges(text: str | None, particles: int) -> tuple[list[tuple[int, int]], list[int]]:
    """Pairs of particles joined by springs, and particles joined to an anchor each; indices from 0."""
    pairs, anchored = [], []
    for part in text.split(",") if text else [f"{k + 1}-anchor" for k in range(particles)]:
        found = re.fullmatch(r"\s*(\d+)\s*-\s*(\d+|anchor|a)\s*", part)
        ends = [int(x) - 1 for x in found.groups() if x.isdigit()] if found else []
        if not found or not all(0 <= k < particles for k in ends) or (len(ends) == 2 and ends[0] == ends[1]):
            raise ValueError(
                f"--edges must be like 1-2,2-anchor with particles from 1 to {particles}, got {part.strip()!r}"
            )
        if len(ends) == 2:
            pairs.append((ends[0], ends[1]))
        else:
            anchored.append(ends[0])
    return pairs, anchored


def start(text: str | None) -> dict[str, float]:
    """ks=20,kd=0.3 as numbers."""
    start = {}
    for part in text.split(",") if text else []:
        found = re.fullmatch(r"\s*(ks|kd)\s*=\s*(\S+)\s*", part)
        value = _floats("--start", found.group(2))[0] if found else -1.0
        if not found or not 0 < value < np.inf:
            raise ValueError(f"--start must be like ks=20,kd=0.3 with positive numbers, got {part.strip()!r}")
        start[found.group(1)] = value
    return start
