"""The log-density of parameters, for samplers: what a fit minimises, as a probability."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from jeuler.fitting.losses import LOSSES
from jeuler.fitting.problem import Problem
from jeuler.fitting.unknowns import Layout


@dataclasses.dataclass(frozen=True)
class Density:
    """The problem that a fit solved, and the size of its noise.

    Attributes:
      variance: of the weighted noise: 1 where sigma was given.
      spread: beyond which a robust loss bends.
    """

    problem: Problem
    loss: str
    variance: float
    spread: float

    @classmethod
    def of(cls, problem: Problem, loss: str, residual: Any, spread: Any) -> Density:
        freedom = max(int(np.sum(np.asarray(problem.weights) > 0)) - problem.layout.size, 1)
        variance = 1.0 if problem.absolute else float(np.sum(np.asarray(residual) ** 2)) / freedom
        return cls(problem, loss, max(variance, 1e-300), float(spread))

    def __call__(self, params: Any) -> Array:
        """The logarithm of the density, up to a constant; -inf outside the bounds."""
        problem = self.problem
        given = Layout.of(params)
        if given.structure != problem.layout.structure or given.shapes != problem.layout.shapes:
            raise ValueError(
                f"params must have the structure and shapes of the fit's params, {problem.layout.structure} with "
                f"{problem.layout.shapes}, got {given.structure} with {given.shapes}"
            )
        x = jnp.asarray(problem.layout.vector(params))
        weights, lower, upper = (jnp.asarray(a, x.dtype) for a in (problem.weights, problem.lower, problem.upper))
        inside = jnp.all((x >= lower) & (x <= upper))
        x = jnp.clip(x, lower, upper)
        off = jnp.where(weights > 0, problem.residual(x, problem.data) * weights, 0)
        bent = LOSSES[self.loss](off / self.spread)[0] * self.spread**2
        total = jnp.sum(bent) / (-2 * self.variance)
        return jnp.where(inside & jnp.isfinite(total), total, -jnp.inf)
