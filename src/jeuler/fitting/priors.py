"""What is known of parameters before a fit: a row of the residual for each.

(parameter - mean) / sigma, and (parameter - its neighbour) / sigma where neighbours are alike.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import numpy as np

from jeuler._core import checks
from jeuler.fitting.unknowns import Layout

Alike = dict[str, tuple[np.ndarray, float]]  # of a parameter: pairs of its numbers, (pair, 2), and sigma


@dataclasses.dataclass(frozen=True)
class Priors:
    """Normal priors of some of the parameters, and of differences of some. Hashable, a part of the program.

    Attributes:
      places: of the parameters.  others: the one that is subtracted; -1 where it is a mean.
      means, sigmas: of each row.
    """

    places: tuple[int, ...]
    others: tuple[int, ...]
    means: tuple[float, ...]
    sigmas: tuple[float, ...]

    @classmethod
    def of(cls, layout: Layout, priors: Any, sigma: Any, loss: str, alike: Alike | None = None) -> Priors | None:
        """From ``{name: (mean, sigma)}`` and pairs of numbers that are alike, or one ValueError."""
        if priors is None and not alike:
            return None
        _refuse(layout, priors, sigma, loss)
        means, sigmas = np.zeros(layout.size), np.full(layout.size, np.inf)
        if priors is not None:
            means = np.asarray(layout.spread("priors", {n: pair[0] for n, pair in priors.items()}, 0.0), float)
            sigmas = np.asarray(layout.spread("priors", {n: pair[1] for n, pair in priors.items()}, np.inf), float)
        wrong = ~(sigmas > 0) | ~np.isfinite(means)
        if wrong.any():
            k = int(np.argmax(wrong))
            raise ValueError(
                f"priors of {layout.names()[k]} must be a finite mean and a sigma greater than 0 (inf leaves it out), "
                f"got ({means[k]:g}, {sigmas[k]:g})"
            )
        places = np.flatnonzero(np.isfinite(sigmas))
        rows = [(int(k), -1, float(means[k]), float(sigmas[k])) for k in places]
        for name, (pairs, own) in (alike or {}).items():
            first = int(np.argmax(np.asarray(layout.spread("smoothness", {name: 1.0}, 0.0))))
            rows += [(first + int(i), first + int(j), 0.0, own) for i, j in pairs]
        return cls(*zip(*rows, strict=True)) if rows else None

    def rows(self, x: Any) -> Any:
        """Parameter minus mean or neighbour, of JAX or NumPy."""
        others = np.asarray(self.others)
        less = x[np.maximum(others, 0)] * (others >= 0).astype(x.dtype)
        return x[np.asarray(self.places)] - less - np.asarray(self.means, x.dtype)

    def after(self, evaluation: Any, x: np.ndarray) -> Any:
        """A residual and its Jacobian with the rows of the priors behind them."""
        r, linearise = evaluation
        others, unit = np.asarray(self.others), np.eye(len(x))

        def jacobian() -> np.ndarray:
            less = unit[np.maximum(others, 0)] * (others >= 0)[:, None]
            return np.concatenate([linearise(), unit[np.asarray(self.places)] - less])

        return np.concatenate([r, self.rows(x)]), jacobian


def _refuse(layout: Layout, priors: Any, sigma: Any, loss: str) -> None:
    """One ValueError for priors of another form, or without what they need."""
    example = jax.tree.unflatten(layout.structure, list(range(len(layout.shapes))))
    known = list(example) if isinstance(example, dict) else []
    if priors is not None and (not isinstance(priors, dict) or not priors):
        raise ValueError(f"priors must be a dict {{name: (mean, sigma)}}, got {checks.shown(priors)}")
    for name, pair in (priors or {}).items():
        if name not in known:
            raise ValueError(f"priors must name parameters, {known or 'of a dict'}, got {name!r}")
        if not isinstance(pair, (tuple, list)) or len(pair) != 2:
            raise ValueError(f"priors[{name!r}] must be a pair (mean, sigma), got {pair!r}")
        if any(map(checks.is_traced, jax.tree.leaves(pair))):
            raise ValueError(f"priors[{name!r}] must be values, got traced ones; put rows into the residual instead")
    what = "priors" if priors is not None else "smoothness"
    if sigma is None:
        raise ValueError(
            f"{what} need sigma, the error of the data: without it their weight against the data is not known"
        )
    if loss != "linear":
        raise ValueError(f'{what} need loss="linear", got {loss!r}: a robust loss would bend them too')
