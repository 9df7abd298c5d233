"""advise_step: the dt that a target error needs, or why there is none."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import jax
import numpy as np

from jeuler import _check, _tree
from jeuler._precision import double_precision, flat
from jeuler.accuracy.pilot import Ladder, Pilot
from jeuler.methods import Step, VectorField, euler_step
from jeuler.stability import Linearisation

PyTree = Any

AIM = 0.8  # of the target: an answer errs on the side of accuracy
TRUST = 0.1  # the extrapolated state must be known to this part of the error it judges
REGULAR = 0.25  # and the observed order be this close to the step's own, to predict beyond the pilots
COUNTER = 2**31 - 1  # steps that the integer clock can count
PILOT_WORK = 2**25  # numbers advanced in the longest pilot run


@dataclasses.dataclass(frozen=True)
class StepAdvice:
    """What `advise_step` found.

    Attributes:
      dt: the step size to use, s, a whole part of t1 - t0; NaN if not feasible.
      num_steps: steps of that size from t0 to t1; 0 if not feasible.
      predicted_error: the error at t1 to expect at that dt, in the terms of the target; if not feasible, the
        least error known to be within reach, or NaN.
      stability_limit: the largest stable dt, s, over sampled states of the run; 0.0 if no dt is (an undamped
        oscillation under `euler_step` grows at any dt, slowly at a small one), inf if every dt is.
      roundoff_floor: the error at t1 below which this step in this precision does not get, in the terms of
        the target.
      feasible: whether dt meets the target.
      reason: what set dt, or why there is none and what could meet the target.
    """

    dt: float
    num_steps: int
    predicted_error: float
    stability_limit: float
    roundoff_floor: float
    feasible: bool
    reason: str


def advise_step(
    f: VectorField,
    y0: PyTree,
    *,
    t1: float,
    error: float,
    t0: float = 0.0,
    args: PyTree = None,
    step: Step = euler_step,
    relative: bool = True,
    compensated: bool = False,
    max_pilot_steps: int | None = None,
) -> StepAdvice:
    """The largest dt whose error at t1 meets a target, from pilot runs; or a reason why no dt does.

        error = |y_dt(t1) - y(t1)| / |y(t1)|,  Euclidean norms over all numbers of the state

    Pilot runs with 16, 32, 64, ... steps are extrapolated to dt = 0 (Richardson). Their errors against that
    state give the dt; a further run at that dt confirms it. Finer targets than the pilots reach are predicted
    by the order of the step, where the errors have been seen to follow it. Pilots run in float64 whatever the
    precision of y0; how far roundoff lets a run in the precision of y0 get is measured on the difference
    between the two.

    Args:
      f: vector field, ``f(t, y, args) -> dy/dt``.
      y0: initial state; its dtype is the precision advised for.
      t1: final time, s.
      error: target at t1, > 0.
      t0: initial time, s.
      args: passed to f.
      step: the method.
      relative: the target is relative to the norm of the state at t1 (True), or in the units of the state
        (False).
      compensated: advise for compensated sums.
      max_pilot_steps: longest pilot run; None takes 2^25 over the numbers in the state, a second or so of
        work.
    Returns: `StepAdvice`; it refuses, ``feasible=False`` with the reason, rather than guess.
    Raises: ValueError, naming the argument, what was expected and what came.
    Example:
      >>> import jeuler
      >>> advice = jeuler.advise_step(lambda t, y, args: -y, 1.0, t1=1.0, error=1e-3)
      >>> advice.feasible, advice.num_steps
      (True, 628)

    Source: L. F. Richardson, The deferred approach to the limit, Phil. Trans. R. Soc. A 226, 1927; P.
      Henrici, Discrete Variable Methods in Ordinary Differential Equations, 1962, sect. 1.4 (roundoff).
    """
    y0 = _check.state("y0", y0)
    for name, value in (("t0", t0), ("t1", t1)):
        _check.number(name, value)
    if not float(t1) > float(t0):
        raise ValueError(f"t1 must be later than t0={float(t0):g}, got {float(t1):g}")
    _check.positive("error", error)
    if any(map(_check.is_traced, jax.tree.leaves((y0, args)))):
        raise ValueError(
            "advise_step must be called with values, got traced ones; call it outside jit, grad, vmap"
        )
    _check.same_form("the vector field f", y0, jax.eval_shape(f, t0, y0, args))
    if max_pilot_steps is None:
        max_pilot_steps = max(4096, PILOT_WORK // max(1, flat(y0).size))
    max_pilot_steps = _check.count("max_pilot_steps", max_pilot_steps, least=64)
    return _Adviser(
        f, y0, float(t0), float(t1), args, step, float(error), relative, compensated, max_pilot_steps
    ).advise()


class _Adviser:
    def __init__(self, f, y0, t0, t1, args, step, error, relative, compensated, most):
        self.f, self.t0, self.t1, self.step, self.error = f, t0, t1, step, error
        self.relative, self.compensated, self.most = relative, compensated, most
        self.interval = t1 - t0
        self.dtype = np.dtype(_tree.time_dtype(y0))
        with double_precision():
            self.y0 = flat(y0)
            self.linear = Linearisation(f, y0, args)
        self.pilot = Pilot(f, y0, t0, t1, args, step, np.float64, compensated)
        self.rough_pilot = Pilot(f, y0, t0, t1, args, step, np.float32, compensated)
        self.name = getattr(step, "__name__", "this step")
        self.stability = math.inf  # largest stable dt
        self.bound = math.inf  # largest dt whose instability, if any, stays small until t1
        self.floor = math.nan

    def advise(self) -> StepAdvice:
        self._look_at_stability(self.y0[None], np.array([self.t0]))
        start = 16
        while start * self.bound < self.interval:
            start *= 2
        if 2 * start > self.most:
            return self._refuse(
                f"{self._stability_asks()}, more than pilot runs of {self.most:,} can look into"
            )
        ladder = self._climb(start)
        if ladder is None:
            if self.bound * self.most < 16 * self.interval:
                return self._refuse(
                    f"{self._stability_asks()}; pilot runs of {self.most:,} cannot tell its error"
                )
            return self._refuse(
                f"the error of {self.name} did not fall as its order says within {self.most:,} steps, so "
                f"none can be predicted; use {self._finer_step()} or an adaptive solver, or raise max_pilot_steps"
            )
        return self._answer(ladder)

    def _stability_asks(self) -> str:
        need = f"dt <= {self.bound:.3g} s, {self.interval / self.bound:.3g} steps"
        if self.stability < 0.5 * self.bound:  # an oscillation that the step makes grow
            return f"oscillations that {self.name} makes grow ask for {need} (rk4_step damps them)"
        return f"stability alone asks for {need} (use implicit_euler_step or linearly_implicit_euler_step)"

    def _finer_step(self) -> str:
        return "heun_step, rk4_step" if self._order() < 4 else "extrapolated_euler(8)"

    def _order(self) -> int:
        return int(getattr(self.step, "order", 1))

    def _scale(self, final: Any) -> float:
        return float(np.linalg.norm(final)) if self.relative else 1.0

    def _look_at_stability(self, states: np.ndarray, times: np.ndarray) -> None:
        with double_precision():
            for state, t in zip(states, times, strict=True):
                try:
                    limit, bound = self.linear.limits(t, state, self.step, interval=self.interval)
                except (ValueError, TypeError, np.linalg.LinAlgError):
                    continue  # a Jacobian that is not finite; the pilots will show what happens there
                self.stability, self.bound = min(self.stability, limit), min(self.bound, bound)

    def _climb(self, num_steps: int) -> Ladder | None:
        """Double the steps until the error of the finest run is known and either meets the target or follows
        the order."""
        ladder, looked = Ladder(self._order()), False
        while num_steps <= self.most:
            states = self.pilot(num_steps)
            ladder.add(num_steps, states[-1])
            if len(ladder.finals) >= 4 and self._trusted(ladder):
                if not looked:
                    looked = True
                    times = self.t0 + self.interval * np.arange(1, len(states) + 1) / len(states)
                    self._look_at_stability(states[::2], times[::2])
                target = self.error * self._scale(ladder.best)
                if ladder.errors()[-1] <= target or self._regular(ladder):
                    return ladder
            num_steps *= 2
        return None

    def _trusted(self, ladder: Ladder) -> bool:
        """Whether the extrapolated state is known well enough, now and one run before, to judge the
        target."""
        if ladder.best is None or not np.all(np.isfinite(ladder.best)):
            return False
        scale = self._scale(ladder.best)
        target = self.error * scale
        orders = ladder.observed_orders()[-2:]
        falling = np.all(orders > 0.5 * self._order()) or ladder.errors()[-1] < 1e-13 * np.linalg.norm(
            ladder.best
        )
        return scale > 0 and falling and ladder.doubt <= TRUST * max(target, ladder.errors()[-1])

    def _regular(self, ladder: Ladder) -> bool:
        """Whether the last errors fall as the order says, so that finer ones may be predicted."""
        orders = ladder.observed_orders()[-3:]
        return (
            bool(np.all(np.abs(orders - self._order()) < REGULAR))
            and ladder.doubt <= TRUST * ladder.errors()[-1]
        )

    def _answer(self, ladder: Ladder) -> StepAdvice:
        scale = self._scale(ladder.best)
        aim, errors, p = AIM * self.error * scale, ladder.errors(), self._order()
        rounding = self._rounding(ladder, scale)
        if errors[-1] > aim:
            num_steps = math.ceil(ladder.num_steps[-1] * (errors[-1] / aim) ** (1 / p))
            predicted = errors[-1] * (ladder.num_steps[-1] / num_steps) ** p
            how = "predicted by the order of the step from pilot runs"
        else:
            num_steps, predicted = self._between(ladder, aim)
            how = "confirmed by a pilot run of that dt"
        least = math.ceil(self.interval / self.bound) if math.isfinite(self.bound) else 1
        if num_steps < least:
            num_steps, how = least, "set by stability, which asks for more than the target does"
            predicted = float(np.linalg.norm(self.pilot(num_steps)[-1] - ladder.best))
        elif predicted < aim / 3:
            how = (
                "set by stability: with fewer steps the run is lost, with these it is better than the target"
            )
        self.floor = rounding.least_total(predicted / scale * num_steps**p, p)
        total = predicted / scale + rounding.at(num_steps)
        if total > 1.25 * self.error:
            cures = [] if self.compensated or not hasattr(self.step, "increment") else ["compensated=True"]
            cures += ["float64"] if self.dtype == np.float32 else []
            cures += [self._finer_step()]
            return self._refuse(
                f"roundoff: in {self.dtype} {self.name} does not get below an error of about "
                f"{self.floor:.1e}, above the target {self.error:.1e}; use {' or '.join(cures)}",
                self.floor,
            )
        if num_steps > COUNTER:
            return self._refuse(
                f"the target asks for {num_steps:.3g} steps, more than the clock can count; "
                f"use {self._finer_step()} or an adaptive solver"
            )
        reason = f"{num_steps:,} steps: {how}"
        if how.startswith("predicted") and num_steps > 10_000_000 and p == 1:
            reason += "; heun_step or rk4_step would need far fewer"
        return StepAdvice(
            self.interval / num_steps, num_steps, total, self.stability, self.floor, True, reason
        )

    def _between(self, ladder: Ladder, aim: float) -> tuple[int, float]:
        """The fewest steps that meet the aim, with all finer rungs below it too: bisection on real runs."""
        errors = ladder.errors()
        rung = len(errors) - 1
        while rung > 0 and errors[rung - 1] <= aim:
            rung -= 1
        high, error_high = ladder.num_steps[rung], float(errors[rung])
        low, error_low = (
            (ladder.num_steps[rung - 1], float(errors[rung - 1])) if rung else (high // 2, math.inf)
        )
        for _ in range(6):
            if high - low <= 1 or error_high > 0.85 * aim:
                break
            if math.isfinite(error_low):  # log-log interpolation, kept off the ends
                part = math.log(error_low / (0.93 * aim)) / math.log(error_low / error_high)
                part = min(max(part, 0.02), 0.98)
            else:
                part = 0.5
            middle = min(max(round(low * (high / low) ** part), low + 1), high - 1)
            error = float(np.linalg.norm(self.pilot(middle)[-1] - ladder.best))
            if error <= aim:  # NaN is not
                high, error_high = middle, error
            else:
                low, error_low = middle, error if math.isfinite(error) else math.inf
        return high, error_high

    def _rounding(self, ladder: Ladder, scale: float) -> Rounding:
        """Roundoff against steps: the difference between pilots in float32 and in float64."""
        counts = [n for n in ladder.num_steps if n <= 2**18][-4:]
        found = []
        for n in counts:
            rough, fine = self.rough_pilot(n)[-1], ladder.finals[ladder.num_steps.index(n)]
            found.append(float(np.linalg.norm(rough - fine)) / scale)
        finer = float(np.finfo(self.dtype).eps / np.finfo(np.float32).eps)
        return Rounding.fitted(np.array(counts, float), np.array(found), finer, self.compensated)

    def _refuse(self, reason: str, reachable: float = math.nan) -> StepAdvice:
        return StepAdvice(math.nan, 0, reachable, self.stability, self.floor, False, reason)


@dataclasses.dataclass(frozen=True)
class Rounding:
    """Roundoff error as a power of the number of steps, size (n / n_0)^growth."""

    size: float
    at_steps: float
    growth: float

    @classmethod
    def fitted(cls, num_steps: np.ndarray, error: np.ndarray, finer: float, compensated: bool) -> Rounding:
        """growth between 1/2 (a random walk) and 1 (a drift) in plain sums, 0 in compensated ones."""
        able = np.isfinite(error) & (error > 0)
        if not able.any():
            return cls(np.finfo(float).eps, 1.0, 0.5)
        num_steps, error = num_steps[able], error[able]
        if compensated:
            return cls(float(error.max()) * finer, 1.0, 0.0)
        slope = np.polyfit(np.log(num_steps), np.log(error), 1)[0] if len(error) > 1 else 0.5
        growth = float(np.clip(slope, 0.5, 1.0))
        size = float(np.exp(np.mean(np.log(error) - growth * np.log(num_steps))))
        return cls(size * finer, 1.0, growth)

    def at(self, num_steps: Any) -> Any:
        return self.size * num_steps**self.growth

    def least_total(self, truncation: float, order: int) -> float:
        """min over n of truncation / n^order + roundoff(n)."""
        if self.growth == 0:
            return self.size
        n = np.logspace(0, 14, 1401)
        return float(np.min(truncation / n**order + self.at(n)))
