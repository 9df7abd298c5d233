"""The values of the springs that were found: from the weak form, and refined by the fit of the whole motion."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np

from jeuler.fitting._springs import SpringFit, fit_springs
from jeuler.fitting.finding.equations import TERMS
from jeuler.fitting.finding.selection import Selection
from jeuler.fitting.finding.tracked import Tracked
from jeuler.fitting.problem import MOST_COLUMNS
from jeuler.fitting.sampling import fastest
from jeuler.forces import Springs
from jeuler.particles.scene import Scene
from jeuler.particles.state import ParticleState

STEPS = 40  # of the simulation in the fastest period
FOLLOWS = 2.0  # times the noise: a fit that leaves more did not follow the motion
NAMES = ("ks", "rest_length", "kd")


@dataclasses.dataclass(frozen=True)
class Values:
    """Springs with standard errors."""

    edges: np.ndarray
    ks: np.ndarray
    kd: np.ndarray
    rest_length: np.ndarray
    stderr: dict[str, np.ndarray]

    def with_errors(self, more: np.ndarray) -> Values:
        """With further errors of ks, rest length and kd, (3, spring)."""
        stderr = {name: np.hypot(self.stderr[name], one) for name, one in zip(NAMES, more, strict=True)}
        return dataclasses.replace(self, stderr=stderr)

    def scene(self, task: Tracked) -> Scene:
        """They and the known forces."""
        numbers = (jnp.asarray(x) for x in (self.ks, self.kd, self.rest_length))
        return Scene((Springs(self.edges, *numbers), *task.forces))

    def state(self, task: Tracked) -> ParticleState:
        """At the first time; who was not seen then is where the smoothed track begins, at rest if there is none."""
        tracks = task.motion.tracks
        first = np.argmax(tracks.known, axis=0)
        who = np.arange(len(task.mass))
        velocity = np.where(np.isfinite(task.mass)[:, None], tracks.velocity[first, who], 0)
        return ParticleState(
            jnp.asarray(tracks.position[first, who]), jnp.asarray(velocity), mass=jnp.asarray(task.mass)
        )


def springs_of(task: Tracked, found: Selection) -> Values:
    """What the weak form says: L = (ks L) / ks, with its error by the first derivatives."""
    count = len(found.chosen)
    ks, length_force, kd = found.values.T if count else np.zeros((3, 0))
    with np.errstate(all="ignore"):
        length = np.where(ks > 0, length_force / ks, 0)
    place = np.full(count * len(TERMS), -1)
    rank = {pair: k for k, pair in enumerate(found.chosen.tolist())}
    for n, index in enumerate(found.active.tolist()):
        place[rank[index // len(TERMS)] * len(TERMS) + index % len(TERMS)] = n
    at = place.reshape(count, len(TERMS))

    def covariance(a: int, b: int) -> np.ndarray:
        used = (at[:, a] >= 0) & (at[:, b] >= 0)
        if not len(found.active):
            return np.zeros(count)
        return np.where(used, found.covariance[at[:, a], at[:, b]], 0)

    with np.errstate(all="ignore"):
        variance = (covariance(1, 1) - 2 * length * covariance(0, 1) + length**2 * covariance(0, 0)) / ks**2
    errors = {"ks": covariance(0, 0), "rest_length": variance, "kd": covariance(2, 2)}
    stderr = {
        name: np.where(at[:, k] >= 0, np.sqrt(np.maximum(errors[name], 0)), np.inf) for k, name in enumerate(NAMES)
    }
    return Values(task.pairs[found.chosen], ks, kd, length, stderr)


def refined(
    task: Tracked, found: Selection, values: Values, explained: bool
) -> tuple[Values, SpringFit | None, list[str]]:
    """The values by the fit of the whole motion; those of the weak form where that cannot be, with a word."""
    moving = int(np.isfinite(task.mass).sum())
    names = tuple(name for name, used in zip(NAMES, found.terms, strict=True) if used)
    size = len(values.ks) * len(names) + 2 * moving * task.positions.shape[2]
    kept = "the values are those of the equations of motion, not refined by a fit of the whole motion"
    if not explained:
        return values, None, [kept]
    if size > MOST_COLUMNS:
        return values, None, [f"{kept}, as {size} numbers are too many for one"]
    scene, state = values.scene(task), values.state(task)
    rate = fastest(scene, task.mass)
    gap = float(np.median(np.diff(np.unique(task.times))))
    dt = gap / np.ceil(gap * rate * STEPS / (2 * np.pi)) if rate > 0 else gap
    try:
        fit = fit_springs(
            scene,
            state,
            task.times,
            np.where(np.isfinite(task.mass)[:, None], task.positions, np.nan),
            dt=dt,
            t0=float(task.times[0]),
            parameters=(*names, "position", "velocity"),
            start="given",
            grow=True,
            sigma=task.motion.sigma,
            step_bias=False,
            progress=False,
        )
    except ValueError as error:
        return values, None, [f"{kept}: {error}"]
    ratio = float(np.sqrt(np.nanmean((np.asarray(fit.predicted) - task.positions)[:, np.isfinite(task.mass)] ** 2)))
    # exact data are followed to the error of the step, not to their rounding
    reach = max(FOLLOWS * task.motion.sigma, 1e-4 * float(np.nanstd(task.positions)))
    if (not fit.converged and ratio > reach) or ratio > 10 * reach:
        return values, None, [f"{kept}, which does not follow it to the end: the motion is chaotic or too long for it"]
    stderr = fit.stderr or {}
    errors = {name: np.asarray(stderr[name], float) if name in stderr else values.stderr[name] for name in NAMES}
    ks, kd, length = (np.asarray(getattr(fit.scene.forces[0], name), float) for name in ("ks", "kd", "rest_length"))
    better = Values(values.edges, ks, kd, length, errors)
    weak = np.flatnonzero(better.ks <= 3 * errors["ks"])
    words = [f"the fit of the whole motion leaves {ratio:.3g} m, the noise being {task.motion.sigma:.3g} m"]
    if len(weak):
        words.append(f"it makes springs {', '.join(str(tuple(values.edges[k].tolist())) for k in weak[:5])} doubtful")
    return better, fit, words
