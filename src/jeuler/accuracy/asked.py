"""What advice is asked for: an equation, or a scene and its state as one, on an interval, and a target error."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from jeuler._core import checks
from jeuler._core.partition import arrays_only
from jeuler.particles.scene import Scene, effects_left_out
from jeuler.solving._breaks import checked_breaks
from jeuler.steps.explicit import VectorField

PyTree = Any


@dataclasses.dataclass(frozen=True)
class Asked:
    """A question, checked.

    Attributes:
      f, y0, t0, t1, args: the equation and its interval.
      error, relative: the target.
      breaks: those from t0 to t1, s.
      name: how the line that makes a run writes the scene, without effects that are left out; "" without a scene.
      left_out: words on effects that are not in the equation, or none.
    """

    f: VectorField
    y0: PyTree
    t0: float
    t1: float
    args: PyTree
    error: float
    relative: bool
    breaks: tuple[float, ...]
    name: str
    left_out: str

    @classmethod
    def of(
        cls, who: str, f: Any, y0: Any, *, t0: Any, t1: Any, args: Any, error: Any, relative: Any, breaks: Any
    ) -> Asked:
        """From what the user passes to ``who``, or one ValueError."""
        name, left_out = "", ""
        if isinstance(f, Scene):
            effects = effects_left_out(f)
            left_out = f"; without {', '.join(effects)}, which pilot runs leave out" if effects else ""
            name = "scene.without_effects()" if effects else "scene"
            (y0, args), f = f.as_equation(y0), f.without_effects().vector_field
        y0 = checks.state("y0", y0)
        checks.untraced(who, y0, args, t0, t1, error)
        t0, t1 = checks.interval(t0, t1)
        checks.positive("error", error)
        checks.field_form(f)
        f, args = arrays_only(f, args)
        checks.vector_field(f, t0, y0, args)
        checks.true_or_false("relative", relative)
        within = tuple(float(b) for b in np.asarray(checked_breaks(breaks, float)) if t0 <= float(b) <= t1)
        return cls(f, y0, t0, t1, args, float(error), relative, within, name, left_out)
