"""What a search of springs says of itself."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from jeuler.fitting.finding.equations import Normal
from jeuler.fitting.finding.selection import Selection
from jeuler.fitting.finding.tracked import Tracked

MUCH = 1.5  # times the noise: more than that is left by a force that is missing
FLOOR = 1e-4  # share of the sum of squares below which what is left is the error of the quadrature
BURIED = 0.1  # of the change of a spring's length: more noise than that makes its ks too low
STRONG = 0.5  # of the median stiffness that was found: a pair that could hide that much was not excited


def not_explained(normal: Normal, found: Selection) -> bool:
    """Whether springs between the tracked particles leave more than noise of the accelerations."""
    return found.surplus > MUCH and found.left > FLOOR * normal.square


def hiding(task: Tracked, found: Selection) -> np.ndarray:
    """Candidates that could hold half of a usual spring unseen, (pair, 2)."""
    rest = np.setdiff1d(np.arange(len(task.pairs)), found.chosen)
    usual = float(np.median(found.values[:, 0])) if len(found.chosen) else 0.0
    return task.pairs[rest[found.least_seen[rest] > STRONG * usual]]


def buried(task: Tracked, found: Selection) -> Iterator[str]:
    """Springs whose lengths change by little beside the noise: the weak form makes these too soft."""
    x, pairs = task.motion.tracks.position, task.pairs[found.chosen]
    change = np.array([np.std(np.linalg.norm(x[:, a] - x[:, b], axis=-1)) for a, b in pairs.tolist()])
    low = pairs[task.motion.sigma > BURIED * change]
    if len(low):
        yield (
            f"the noise is more than {BURIED:g} of what the lengths of springs {_list(map(tuple, low.tolist()))} "
            f"change by: their ks may be too low by more than the errors say"
        )


def too_coarse(task: Tracked, omega: float) -> str:
    """Where a motion is in the tracks that the springs were not given to explain."""
    samples = 2 * np.pi / (omega * task.motion.tracks.spacing)
    return (
        f"a motion of {omega:.3g} rad/s is not followed, {samples:.2g} samples a period: what was taken for noise is "
        f"motion, and springs, errors and what was not found are not to be trusted; take more samples a second"
    )


def sentences(task: Tracked, normal: Normal, found: Selection, alpha: float, hidden: np.ndarray) -> Iterator[str]:
    """One after the other, the most important first."""
    if not_explained(normal, found):
        share = 100 * np.sqrt(found.left / max(normal.square, 1e-300))
        yield (
            f"springs between these particles do not explain the motion: {found.surplus:.2g} times the noise is left, "
            f"{share:.2g} % of the accelerations; a particle that was not tracked, or a force that was not given, acts "
            f"on them, and the springs are not to be trusted"
        )
    count = len(found.chosen)
    yield (
        f"{count} spring{'s' * (count != 1)} among {len(task.pairs)} candidate pairs, with a chance of about "
        f"{alpha:.2g} that noise put one too many there"
    )
    if task.left_out:
        yield f"particles {_list(task.left_out)} were seen too seldom: springs to them are not looked for"
    still = sorted(set(np.flatnonzero(np.isfinite(task.mass) & ~normal.seen).tolist()) - set(task.left_out))
    if still:
        yield f"particles {_list(still)} are never seen together with all others: only what these feel is used"
    if task.nearest:
        yield f"only the {len(task.pairs)} nearest pairs were looked at; give others as candidates="
    if not_explained(normal, found):
        return
    rest = np.setdiff1d(np.arange(len(task.pairs)), found.chosen)
    if len(hidden):
        yield (
            f"the motion does not excite {len(hidden)} other pair{'s' * (len(hidden) != 1)}, such as "
            f"{_list(map(tuple, hidden.tolist()))}: a spring there could be there unseen"
        )
    elif len(rest):
        most = float(np.max(found.least_seen[rest]))
        yield f"a spring of {most:.2g} N/m or more between any other pair would have been found, with a chance of 95 %"
    if count and not found.terms[1]:
        yield "rest lengths of 0 do as well as any others"
    if count and not found.terms[2]:
        yield "no damping is seen"


def _list(items) -> str:
    items = [str(item) for item in items]
    return ", ".join(items[:5]) + (f" and {len(items) - 5} more" if len(items) > 5 else "")
