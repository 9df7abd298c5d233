"""Losses of a residual: squares, and two that bend for outliers. Each for arrays of NumPy and of JAX."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from jeuler.fitting.factors import namespace


class Loss(NamedTuple):
    """rho(z), the square root of d rho / d(z^2), and d^2 rho / dz^2 / 2.

    The second is the weight of a residual in the quadratic model, the third what an error's covariance needs.
    """

    name: str
    values_and_slope: Callable[[Any], tuple[Any, Any]]
    curvature: Callable[[Any], Any]

    def __call__(self, z: Any) -> tuple[Any, Any]:
        return self.values_and_slope(z)


def _linear(z: Any) -> tuple[Any, Any]:
    return z**2, namespace(z).ones_like(z)


def _soft_l1(z: Any) -> tuple[Any, Any]:
    root = namespace(z).sqrt(1 + z**2)
    return 2 * z**2 / (1 + root), 1 / namespace(z).sqrt(root)


def _huber(z: Any) -> tuple[Any, Any]:
    xp = namespace(z)
    size = xp.maximum(xp.abs(z), 1)
    return xp.where(size > 1, 2 * size - 1, z**2), 1 / xp.sqrt(size)


LOSSES = {
    "linear": Loss("linear", _linear, lambda z: namespace(z).ones_like(z)),
    "soft_l1": Loss("soft_l1", _soft_l1, lambda z: (1 + z**2) ** -1.5),
    "huber": Loss("huber", _huber, lambda z: namespace(z).where(abs(z) <= 1, 1.0, 0.0)),
}
