"""How a fit is done, and what its caller knows of the data."""

from __future__ import annotations

import dataclasses
from typing import Any

from jeuler._core import checks
from jeuler.fitting.losses import LOSSES


@dataclasses.dataclass(frozen=True)
class Options:
    """How a fit is done."""

    loss: str = "linear"
    loss_scale: float | None = None
    starts: Any = None
    optimizer: Any = None
    minibatch: int | None = None
    max_iterations: int = 200
    tolerance: float = 1e-4
    resume: Any = None
    progress: bool | None = None

    def __post_init__(self) -> None:
        """One ValueError that says which option is wrong."""
        object.__setattr__(self, "max_iterations", checks.count("max_iterations", self.max_iterations, least=1))
        checks.positive("tolerance", self.tolerance)
        if self.loss not in LOSSES:
            raise ValueError(f"loss must be one of {', '.join(map(repr, LOSSES))}, got {self.loss!r}")
        if self.loss_scale is not None:
            checks.positive("loss_scale", self.loss_scale)
        if self.optimizer is not None and not hasattr(self.optimizer, "update"):
            raise ValueError(
                f"optimizer must be an optax optimiser, such as optax.adam(0.05), or None, got {self.optimizer!r}"
            )
        if self.minibatch is not None:
            object.__setattr__(self, "minibatch", checks.count("minibatch", self.minibatch, least=1))
            if self.optimizer is None:
                raise ValueError(
                    "minibatch is for an optax optimiser; leave it out, or pass optimizer=optax.adam(0.01)"
                )
        if self.optimizer is not None:
            if self.starts is not None:
                raise ValueError("starts is for Levenberg-Marquardt; leave it out, or leave optimizer out")
            if self.loss != "linear":
                raise ValueError('loss must be "linear" with an optax optimiser; put the loss into the residual')


@dataclasses.dataclass(frozen=True)
class Known:
    """What a caller knows of the data: for the share explained and the residual against the noise.

    Attributes:
      variance: sum of squares of the data about their mean, weighted; None where it is not known.
      noise: standard deviation of the noise, weighted; None where it is not known.
      more: further sentences for the message.
      near: whether the start is likely near the minimum, as where it was found from the data.
    """

    variance: float | None = None
    noise: float | None = None
    more: tuple[str, ...] = ()
    near: bool = False
