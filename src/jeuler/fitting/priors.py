"""What is known of parameters before a fit: a row of the residual for each, (parameter - mean) / sigma."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import numpy as np

from jeuler._core import checks
from jeuler.fitting.unknowns import Layout


@dataclasses.dataclass(frozen=True)
class Priors:
    """Normal priors of some of the parameters. Hashable, a part of the program."""

    places: tuple[int, ...]
    means: tuple[float, ...]
    sigmas: tuple[float, ...]

    @classmethod
    def of(cls, layout: Layout, priors: Any, sigma: Any, loss: str) -> Priors | None:
        """From ``{name: (mean, sigma)}``, or one ValueError."""
        if priors is None:
            return None
        example = jax.tree.unflatten(layout.structure, list(range(len(layout.shapes))))
        known = list(example) if isinstance(example, dict) else []
        if not isinstance(priors, dict) or not priors:
            raise ValueError(f"priors must be a dict {{name: (mean, sigma)}}, got {checks.shown(priors)}")
        for name, pair in priors.items():
            if name not in known:
                raise ValueError(f"priors must name parameters, {known or 'of a dict'}, got {name!r}")
            if not isinstance(pair, (tuple, list)) or len(pair) != 2:
                raise ValueError(f"priors[{name!r}] must be a pair (mean, sigma), got {pair!r}")
            if any(map(checks.is_traced, jax.tree.leaves(pair))):
                raise ValueError(
                    f"priors[{name!r}] must be values, got traced ones; put rows into the residual instead"
                )
        if sigma is None:
            raise ValueError(
                "priors need sigma, the error of the data: without it their weight against the data is not known"
            )
        if loss != "linear":
            raise ValueError(f'priors need loss="linear", got {loss!r}: a robust loss would bend them too')
        means = np.asarray(layout.spread("priors", {name: pair[0] for name, pair in priors.items()}, 0.0), float)
        sigmas = np.asarray(layout.spread("priors", {name: pair[1] for name, pair in priors.items()}, np.inf), float)
        wrong = ~(sigmas > 0) | ~np.isfinite(means)
        if wrong.any():
            k = int(np.argmax(wrong))
            raise ValueError(
                f"priors of {layout.names()[k]} must be a finite mean and a sigma greater than 0 (inf leaves it out), "
                f"got ({means[k]:g}, {sigmas[k]:g})"
            )
        places = np.flatnonzero(np.isfinite(sigmas))
        if not len(places):
            return None
        return cls(tuple(places.tolist()), tuple(means[places].tolist()), tuple(sigmas[places].tolist()))

    def rows(self, x: Any) -> Any:
        """Parameter minus mean, of JAX or NumPy."""
        return x[np.asarray(self.places)] - np.asarray(self.means, x.dtype)

    def after(self, evaluation: Any, x: np.ndarray) -> Any:
        """A residual and its Jacobian with the rows of the priors behind them."""
        r, linearise = evaluation

        def jacobian() -> np.ndarray:
            return np.concatenate([linearise(), np.eye(len(x))[np.asarray(self.places)]])

        return np.concatenate([r, self.rows(x)]), jacobian
