"""Springs that are like their neighbours in the net: pairs of numbers whose difference has a prior."""

from __future__ import annotations

from typing import Any

import numpy as np

from jeuler._core import checks
from jeuler.fitting.parameters import Places, owners_of, parts_of
from jeuler.fitting.priors import Alike
from jeuler.forces.springs import Springs
from jeuler.particles.scene import Scene


def alike_neighbours(scene: Scene, places: Places, smoothness: Any) -> Alike:
    """From ``{name: sigma}``: the pairs of numbers of springs that share a particle, or one ValueError."""
    if smoothness is None:
        return {}
    if not isinstance(smoothness, dict) or not smoothness:
        raise ValueError(f"smoothness must be a dict {{name: sigma}}, got {checks.shown(smoothness)}")
    found: Alike = {}
    for name, sigma in smoothness.items():
        if name not in places.names:
            raise ValueError(f"smoothness must name parameters, {places.names}, got {name!r}")
        checks.positive(f"smoothness[{name!r}]", sigma)
        pairs = _pairs(scene, places, name)
        if not len(pairs):
            raise ValueError(
                f"smoothness[{name!r}] needs a parameter with one number for each spring, of springs that share "
                f"particles; give it that shape, or leave it out"
            )
        found[name] = pairs, float(sigma)
    return found


def _pairs(scene: Scene, places: Places, name: str) -> np.ndarray:
    """Pairs of the numbers of a parameter, each pair once, (pair, 2)."""
    owners, field = owners_of(scene, name)
    ends, numbers, first = [], [], 0
    for owner in owners:
        force = parts_of(scene)[owner]
        size = np.size(getattr(force, field))
        if isinstance(force, Springs) and np.ndim(getattr(force, field)):
            ends.append(np.asarray(force.edges[:]))
            numbers.append(first + np.arange(size))
        first += size
    if not ends:
        return np.zeros((0, 2), int)
    number = np.concatenate(numbers)
    tie = next((tie for tie in places.ties if tie.name == name), None)
    number = number if tie is None else np.asarray(tie.groups)[number]
    return shared_particles(np.concatenate(ends), number)


def shared_particles(edges: np.ndarray, number: np.ndarray) -> np.ndarray:
    """The pairs of different numbers among those of the springs at each particle, each pair once."""
    pairs = set()
    order = np.argsort(edges.ravel(), kind="stable")
    at, owner = edges.ravel()[order], np.repeat(number, 2)[order]
    for some in np.split(owner, np.flatnonzero(np.diff(at)) + 1):
        own = sorted(set(some.tolist()))
        pairs |= {(i, j) for k, i in enumerate(own) for j in own[k + 1 :]}
    return np.asarray(sorted(pairs), int).reshape(-1, 2)
