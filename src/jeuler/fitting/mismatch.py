"""What does not belong together where a fit explains little: positions, state and rest lengths in other units."""

from __future__ import annotations

import numpy as np

from jeuler.fitting.observations import amplitude_of
from jeuler.forces.springs import Springs
from jeuler.particles.scene import Scene
from jeuler.particles.state import ParticleState

FAR = 0.5  # of the motion: a first position farther from the state than this is not that of the state
OTHER_UNIT = 30.0  # times: rest lengths so much longer or shorter than the springs are


def mismatched(scene: Scene, state: ParticleState, times: np.ndarray, targets: np.ndarray, t0: float) -> list[str]:
    """Sentences about a state that is not where the positions begin, and rest lengths unlike the springs' lengths."""
    words = []
    x = np.asarray(state.position, float)
    gap = np.median(np.diff(np.unique(times))) if len(np.unique(times)) > 1 else np.inf
    if times[0] - t0 <= gap:
        off = float(np.sqrt(np.nanmean((targets[0] - x) ** 2))) if np.isfinite(targets[0]).any() else 0.0
        if off > FAR * amplitude_of(targets):
            words.append(
                f"the positions begin {off:.2g} m from where the state is: give both in one unit, from one origin and "
                f"in one order of particles, or fit the initial positions too, parameters=(..., 'position')"
            )
    for k, force in enumerate(scene.forces):
        if not isinstance(force, Springs) or not len(force.edges):
            continue
        pairs = np.asarray(force.edges[:])
        length = float(np.median(np.linalg.norm(x[pairs[:, 0]] - x[pairs[:, 1]], axis=-1)))
        rest = float(np.median(np.asarray(force.at(t0).rest_length)))
        if min(length, rest) > 0 and not 1 / OTHER_UNIT < rest / length < OTHER_UNIT:
            words.append(
                f"forces[{k}].rest_length is {rest:.2g} m where the springs are {length:.2g} m long: "
                f"give both in one unit"
            )
    return words
