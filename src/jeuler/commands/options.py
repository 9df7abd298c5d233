"""The options of the command line, from text to numbers; and the built-in example."""

from __future__ import annotations

import math
import re

import numpy as np

from jeuler.commands.model import FRICTIONS
from jeuler.commands.selection import Measurement

EXAMPLE = {"mass": 0.5, "ks": 20.0, "kd": 0.3, "rest": 0.1, "noise": 0.001}


def example() -> Measurement:
    """A damped spring, by its closed form, with noise: data that the fit's own steps did not make.

    x = rest + exp(-c t) (x0 cos(w t) + x0 c / w sin(w t)),  c = kd / (2 m),  w^2 = ks / m - c^2
    """
    times = np.linspace(0.0, 8.0, 241)
    start, mass = 0.16 - EXAMPLE["rest"], EXAMPLE["mass"]
    decay = EXAMPLE["kd"] / (2 * mass)
    omega = math.sqrt(EXAMPLE["ks"] / mass - decay**2)
    swing = start * (np.cos(omega * times) + decay / omega * np.sin(omega * times))
    position = EXAMPLE["rest"] + np.exp(-decay * times) * swing
    noise = EXAMPLE["noise"] * np.random.default_rng(7).standard_normal(len(times))
    return Measurement("built-in example", "", "t", times, (position + noise)[:, None, None], ["x"])


def _floats(option: str, text: str) -> list[float]:
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        raise ValueError(f"{option} must be numbers separated by commas, got {text!r}") from None


def masses(text: str | None, particles: int) -> np.ndarray:
    """Mass of each particle, kg; NaN for one that is to be fitted."""
    if text is None:
        return np.ones(particles)
    parts = ["?"] * particles if text.strip() == "fit" else [part.strip() for part in text.split(",")]
    known = [part for part in parts if part != "?"]
    values = _floats("--mass", ",".join(known)) if known else []
    if len(parts) not in (1, particles) or not all(1e-12 < value < 1e12 for value in values):
        raise ValueError(
            f"--mass must be one positive number of kg or {particles}, one a particle (? for one to be found), "
            f"got {text!r}"
        )
    if not known:
        raise ValueError(
            f"--mass {text}: one mass at least must be known, as a motion without a measured force determines masses "
            f"and stiffnesses only as their ratio: give one, such as --mass {','.join(['1', *'?' * (particles - 1)])}"
        )
    filled = iter(values)
    return np.broadcast_to([next(filled) if part != "?" else math.nan for part in parts], (particles,)).copy()


def known_masses(text: str | None, particles: int) -> np.ndarray:
    """Mass of each particle, kg; inf for one that is pinned."""
    if text is None:
        return np.ones(particles)
    values = _floats("--mass", text)
    if len(values) not in (1, particles) or not all(1e-12 < value < 1e12 or value == math.inf for value in values):
        raise ValueError(
            f"--mass must be one positive number of kg or {particles}, one a particle (inf for one that is pinned), "
            f"got {text!r}"
        )
    return np.broadcast_to(values, (particles,)).copy()


def vector(option: str, text: str | None, dim: int) -> np.ndarray | None:
    """One number a coordinate; None where the option is not given."""
    if text is None:
        return None
    values = _floats(option, text)
    if len(values) != dim or not np.isfinite(values).all():
        raise ValueError(f"{option} must be {dim} finite numbers, one a coordinate, got {text!r}")
    return np.array(values)


def edges(text: str | None, particles: int) -> tuple[list[tuple[int, int]], list[int]]:
    """Pairs of particles joined by springs, and particles joined to an anchor each; indices from 0."""
    pairs: list[tuple[int, int]] = []
    anchored: list[int] = []
    for part in text.split(",") if text is not None else [f"{k + 1}-anchor" for k in range(particles)]:
        found = re.fullmatch(r"\s*(\d{1,9})\s*-\s*(\d{1,9}|anchor|a)\s*", part, re.ASCII)
        ends = [int(x) - 1 for x in found.groups() if x.isdigit()] if found else []
        if not found or not all(0 <= k < particles for k in ends) or (len(ends) == 2 and ends[0] == ends[1]):
            raise ValueError(
                f"--edges must be like 1-2,2-anchor with particles from 1 to {particles}, got {part.strip()!r}"
            )
        edge = tuple(sorted(ends)) if len(ends) == 2 else ends[0]
        if edge in (pairs if len(ends) == 2 else anchored):
            raise ValueError(f"--edges names the spring {part.strip()!r} twice; its ks would be split arbitrarily")
        if isinstance(edge, tuple):
            pairs.append((edge[0], edge[1]))
        else:
            anchored.append(edge)
    return pairs, sorted(anchored)


def start(text: str | None) -> dict[str, float]:
    """``ks=20,kd=0.3`` as a dictionary."""
    start = {}
    for part in text.split(",") if text is not None else []:
        found = re.fullmatch(r"\s*(ks|kd)\s*=\s*(\S+)\s*", part)
        value = _floats("--start", found.group(2))[0] if found else -1.0
        if not found or not 0 < value < 1e15:
            raise ValueError(f"--start must be like ks=20,kd=0.3 with positive numbers, got {part.strip()!r}")
        if found.group(1) in start:
            raise ValueError(f"--start must name {found.group(1)} once, got {text!r}")
        start[found.group(1)] = value
    return start


def frictions(text: str | None) -> tuple[str, ...]:
    """``viscous+dry`` as a tuple of kinds."""
    kinds = tuple(part.strip() for part in (text or "viscous").split("+"))
    if not all(kind in FRICTIONS for kind in kinds) or len(set(kinds)) < len(kinds):
        raise ValueError(
            f"--friction must be viscous, quadratic or dry, several joined by + (viscous+dry), or compare, got {text!r}"
        )
    return tuple(kind for kind in FRICTIONS if kind in kinds)


def delays(text: str | None, particles: int, driven: bool) -> tuple[float, ...]:
    """By how much each channel, or a driven motion, is late, s; NaN where it is to be found."""
    if text is None:
        return ()
    if text.strip() == "fit":
        return (math.nan,) if driven else (0.0, *[math.nan] * (particles - 1))
    parts = [part.strip() for part in text.split(",")]
    known = [part for part in parts if part != "?"]
    values = iter(_floats("--delay", ",".join(known)) if known else [])
    late = tuple(math.nan if part == "?" else next(values) for part in parts)
    if len(late) != particles or any(abs(value) > 1e6 for value in late):
        raise ValueError(
            f"--delay must be fit, or {particles} numbers of s, one a particle (? for one to be found), got {text!r}"
        )
    if not known and not driven:
        raise ValueError(
            f"--delay {text}: one delay must be known, as only differences show: --delay {','.join(['0', *parts[1:]])}"
        )
    return late


def check_number(option: str, value: float | None, positive: bool = False) -> None:
    """One ValueError if an option is not a finite number, or not above 0 where it must be."""
    if value is not None and (not math.isfinite(value) or (positive and value <= 0)):
        raise ValueError(f"{option} must be a {'positive ' if positive else ''}finite number, got {value:g}")
