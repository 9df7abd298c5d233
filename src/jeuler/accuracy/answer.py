"""What a search for dt found, in numbers and words."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from jeuler._core.component import result
from jeuler.accuracy.pilot import Ladder, distance
from jeuler.accuracy.roundoff import COUNTER
from jeuler.accuracy.search import AIM, FACTOR, Search
from jeuler.accuracy.uneven import fewest_uneven
from jeuler.steps.explicit import rk4_step

PyTree = Any

FEW = 64  # steps: one fewer may make a difference
MANY = 10_000_000  # steps: what does with far fewer is looked for
ROUGHLY = 2**14  # steps of RK4, to see whether its fewer roundings meet a target
LARGER = 0.9  # part of the steps at whose dt instability is to be seen if it is what sets dt:
NEAR_LIMIT, NEAR_LIMIT_UNEVEN = 0.2, 0.5  # of the stable dt, more where jumps make errors grow too; and it grows by
UNSTABLE = 4.0  # times the error that the order says


@result
class StepAdvice:
    """What `advise_step` found.

    Attributes:
      dt: the step size to use, s, t1 - t0 over a whole number of steps; NaN if not feasible.
      num_steps: steps of that size from t0 to t1; 0 if not feasible.
      predicted_error: the error at t1 to expect at that dt, in the terms of the target; if not feasible, the
        least error known to be within reach, or NaN.
      stability_limit: the largest stable dt, s, over sampled states of the run; 0.0 if no dt is (an undamped
        oscillation under `euler_step` grows at any dt, slowly at a small one), inf if every dt is.
      roundoff_floor: the error at t1 below which this step in this precision does not get with any number of
        steps that the clock can count, in the terms of the target; see `advise_step` for how far to trust it.
      feasible: whether dt meets the target.
      reason: what set dt, or why there is none and what could meet the target.
    Example:
      >>> import jeuler
      >>> stiff = lambda t, y, args: -1000.0 * (y - 1.0)
      >>> advice = jeuler.advise_step(stiff, 2.0, t1=1.0, error=1e-2)
      >>> round(advice.stability_limit, 6), advice.feasible, advice.reason.split(":")[1]
      (0.002, True, ' stability, not accuracy, sets dt')
    """

    dt: float
    num_steps: int
    predicted_error: float
    stability_limit: float
    roundoff_floor: float
    feasible: bool
    reason: str


def is_explicit(step: Any) -> bool:
    """Whether a step solves no equations."""
    return hasattr(getattr(step, "base", step), "increment")


class Answer:
    """Makes the `StepAdvice` of a search: an answer or a refusal, with its reason."""

    def __init__(self, search: Search) -> None:
        self.search = search
        self.name = getattr(search.step, "__name__", "this step")
        self.floor = math.nan

    def advice(self) -> StepAdvice:
        search = self.search
        if not search.bound > 0:
            return self.refusal(
                f"{self.name} makes an oscillation grow at every dt, too far for any use at t1; use rk4_step"
            )
        known = search.reference
        if search.relative and known is not None and not known.vanishes:
            lost = known.roundoff / search.scale(known.final)
            if lost > search.error:
                return self.refusal(
                    f"roundoff: the state at t1 is so small beside those on the way there that rounding them in "
                    f"float64 changes it by {lost:.1e} of its size; "
                    f"give a target in the units of the state, relative=False",
                    lost,
                )
        start = 16
        while start * search.bound < search.interval and 2 * start <= search.most:
            start *= 2
        ladder, even = search.confirmed(start) if 2 * start <= search.most else (None, False)
        if ladder is not None and even:
            return self.answer(ladder)
        if known is not None:
            search.look_at_stability(known.states[:-1:2], known.times[:-1:2])
            found = fewest_uneven(search, known.final) if search.bound * search.most >= search.interval else None
            if found is not None:
                return self.uneven(known.final, *found)
            if ladder is None and (led := search.by_leading_term(known)) is not None:
                return self.led(known.final, *led)
        return self.refusal(self.no_answer(ladder) + self.remedy())

    def no_answer(self, ladder: Ladder | None) -> str:
        """What stands in the way of an answer."""
        search, most = self.search, f"{self.search.most:,} steps"
        unstable = search.bound * search.most < 2 * search.interval
        if search.patience.over and not unstable:
            return f"patience={search.patience.seconds:g} s was over before an answer was known{self.last_errors()}"
        if ladder is not None:
            return (
                f"the error of {self.name} does not fall evenly with dt (f may jump), and no run of up to {most} "
                f"met the target"
            )
        if unstable:
            return f"{self.needs()}, more than the longest pilot run, {most}, can check"
        if search.bound * search.most < 16 * search.interval:
            return f"{self.needs()}, and no pilot run of up to {most} met the target"
        return (
            f"no run of up to {most} is known to meet the target, and the errors of {self.name} there do not follow "
            f"its order, {search.order}, by which dt could be predicted{self.last_errors()}"
        )

    def last_errors(self) -> str:
        """What the longest two runs of the ladder were off by, where that is known."""
        known, seen = self.search.reference, list(self.search.seen.items())[-2:]
        if known is None or not seen:
            return ""
        target = self.search.error * self.search.scale(known.final)
        errors = {n: distance(end, known.final) / target for n, end in seen}
        words = [f"{e:.3g} times the target" if math.isfinite(e) else "not finite" for e in errors.values()]
        return f": with {' and '.join(f'{n:,}' for n in errors)} steps the error is {' and '.join(words)}"

    def remedy(self) -> str:
        """What meets the target instead: an adaptive run that was made."""
        if self.search.reference is None:
            if self.search.patience.over:
                return "; until then no adaptive run was known to meet it; raise patience, or take a shorter interval"
            return "; no adaptive run is known to meet it either; raise max_pilot_steps, or take a shorter interval"
        words = f"; use {self.search.reference.words}, whose run is known to meet the target"
        fewer = self.search.implicit_steps(self.search.reference.final, 4096) if is_explicit(self.search.step) else None
        return words + (f", or {fewer:,} step{'s' * (fewer > 1)} of linearly_implicit_euler_step" if fewer else "")

    def answer(self, ladder: Ladder) -> StepAdvice:
        search = self.search
        target = search.target(ladder)
        seen = ladder.errors()[-1] <= AIM * target
        num_steps, error = search.fewest(ladder) if seen else search.predicted(ladder)
        if seen and error < target / FACTOR and not self.near_instability(num_steps):
            final: Any = ladder.best if search.reference is None else search.reference.final
            num_steps, error = fewest_uneven(search, final, start=max(1, num_steps // 4)) or (num_steps, error)
        if error < target / FACTOR:
            how = lambda: self.far_below(ladder.best, num_steps, target / error if error > 0 else math.inf)  # noqa: E731
        elif seen:
            how = lambda: "confirmed by a pilot run of that dt"  # noqa: E731
        else:
            how = lambda: "predicted by the order of the step from pilot runs" + self.fewer(num_steps, ladder.best)  # noqa: E731
        return self.judged(ladder, num_steps, error, how)

    def led(self, final: Any, num_steps: int, error: float, seen: int) -> StepAdvice:
        """An answer far beyond the pilots, by the leading term of the error along an adaptive run."""
        ladder = Ladder(self.search.order, [seen], [self.search.pilot(seen)[-1]], final, 0.0)
        how = f"predicted by the leading term of the error along an adaptive run, as a run of {seen:,} steps bears out"
        return self.judged(ladder, num_steps, error, lambda: how + self.fewer(num_steps, final))

    def judged(self, ladder: Ladder, num_steps: int, error: float, how: Callable[[], str]) -> StepAdvice:
        """The answer, if roundoff and the clock allow it."""
        search, scale = self.search, self.search.scale(ladder.best)
        rounding = search.rounding(ladder)
        self.floor, _ = rounding.floor(error / scale * num_steps**search.order, search.order)
        if num_steps > COUNTER:
            return self.refusal(
                f"the target asks for {num_steps:.3g} steps, more than the clock can count" + self.remedy()
            )
        total = error / scale + rounding.after(num_steps)
        if total > 1.25 * search.error:
            return self.refusal(
                f"roundoff: in {search.dtype} {self.name} does not get below an error of about "
                f"{self.floor:.1e}, above the target {search.error:.1e}; {self.cures(num_steps, ladder.best)}",
                self.floor,
            )
        return self.advised(num_steps, total, how(), ladder.best)

    def advised(self, num_steps: int, total: float, how: str, final: Any) -> StepAdvice:
        """An answer with what else there is to say of it."""
        search = self.search
        reason = f"{num_steps:,} step{'s' * (num_steps > 1)}: {how}{self.jumps(num_steps, final)}"
        if search.vanishing and search.relative:
            reason += "; the state at t1 is 0 but for roundoff, so the target is taken in the units of the state"
        return StepAdvice(search.interval / num_steps, num_steps, total, search.stability, self.floor, True, reason)

    def fewer(self, num_steps: int, final: Any) -> str:
        """What meets the target with far fewer steps, where these are many: a run that was made."""
        search = self.search
        if num_steps <= MANY:
            return ""
        if (
            is_explicit(search.step)
            and search.order < 4
            and (fewer := search.steps_of(rk4_step, final, search.planned))
        ):
            return f"; rk4_step meets the target with {fewer:,} steps"
        return "" if search.reference is None else f"; {search.reference.words} meets the target too"

    def jumps(self, num_steps: int, final: Any) -> str:
        """Words on an end of the interval where f jumps, if the error is far smaller with it among the breaks."""
        search, ends = self.search, []
        for name, t, inside in (("t0", search.t0, 1), ("t1", search.t1, -1)):
            if t not in search.breaks and search.jumps_at(t, inside, final):
                ends.append((name, t))
        if not ends or num_steps > search.most:
            return ""
        breaks = tuple(sorted({*search.breaks, *(t for _, t in ends)}))
        known = search.runs(search.step, np.float64, search.compensated, breaks)(num_steps)[-1]
        better = search.error_after(num_steps, final) / max(
            distance(known, final) / search.scale(final) / search.error, 1e-16
        )
        if not better > FACTOR:
            return ""
        where = " and ".join(f"{name}={t:g}" for name, t in ends)
        return f"; f jumps at {where}: with that among the breaks the error is {better:.2g} times smaller"

    def uneven(self, final: Any, num_steps: int, error: float) -> StepAdvice:
        """An answer where errors do not follow the order: that of a run of the advised step itself."""
        search = self.search
        rounding = search.rounding(Ladder(search.order, [num_steps], [search.pilot(num_steps)[-1]], final, 0.0))
        total = error / search.scale(final) + rounding.after(num_steps)
        if total > search.error:
            return self.refusal(f"roundoff in {search.dtype} leaves no error below {total:.1e}", total)
        if error < search.error * search.scale(final) / FACTOR:
            better = search.error * search.scale(final) / error if error > 0 else math.inf
            how = self.far_below(final, num_steps, better, NEAR_LIMIT_UNEVEN)
        else:
            how = "confirmed by a pilot run of that dt"
        how += "; against an adaptive run, as the error was not seen to fall evenly with dt"
        return self.advised(num_steps, total, how, final)

    def far_below(self, final: Any, num_steps: int, better: float, part: float = NEAR_LIMIT) -> str:
        """Why an error is far below the target: as one step fewer misses it, or as larger dts grow or jump."""
        search, smaller = self.search, f"the error is {better:.2g} times smaller than asked"
        if math.isinf(better):
            smaller, better = "no error is seen", 1e100
        if num_steps == 1:
            return f"one step is enough: {smaller}"
        fewer = min(math.floor(LARGER * num_steps), num_steps - 1)
        growth = search.error_after(fewer, final) * better / (num_steps / fewer) ** search.order
        if growth < UNSTABLE or not self.near_instability(num_steps, part):
            one_fewer = search.error_after(num_steps - 1, final)
            if num_steps <= FEW and one_fewer > AIM:
                aimed = "" if one_fewer > 1 else f" ({AIM:g} is aimed at)"
                return f"{smaller}, but with one step fewer it is {one_fewer:.2g} times the target{aimed}"
            return f"{smaller}; no larger dt that was run meets the target with runs beside it within a factor 3"
        how = f"stability, not accuracy, sets dt: {smaller}"
        if is_explicit(self.search.step) and (steps := search.implicit_steps(final, num_steps // 2)):
            how += f"; linearly_implicit_euler_step meets the target with {steps:,} step{'s' * (steps > 1)}"
        return how

    def near_instability(self, num_steps: int, part: float = NEAR_LIMIT) -> bool:
        """Whether dt is not far below a limit of stability at the states looked at."""
        return self.search.interval / num_steps > part * self.search.stability

    def needs(self) -> str:
        bound = self.search.bound
        need = f"dt <= {bound:.3g} s, {self.search.interval / bound:.3g} steps"
        if self.search.stability < 0.5 * bound:  # an oscillation that the step makes grow
            return f"oscillations that {self.name} makes grow ask for {need}"
        return f"stability alone asks for {need}"

    def cures(self, num_steps: int, final: Any) -> str:
        """What takes roundoff further down: what a run shows to meet the target, or else what was not run."""
        search, ways = self.search, {}
        spaced = search.error < np.finfo(search.dtype).eps / 4  # the target is below the spacing of numbers
        if hasattr(search.step, "increment") and not (search.compensated or spaced):
            ways["compensated=True"] = search.dtype, True
        if search.dtype == np.float32:
            ways["float64"] = np.float64, search.compensated
        able = num_steps <= search.most and not search.patience.over
        met = [name for name, way in ways.items() if able and search.meets(num_steps, final, *way)]
        cures = [f"{' or '.join(met)} with {num_steps:,} steps"] if met else []
        if search.order < 4 and not spaced and (fewer := search.steps_of(rk4_step, final, ROUGHLY, search.dtype)):
            cures.append(f"rk4_step with {fewer:,} step{'s' * (fewer > 1)}")
        if cures:
            return f"use {', or '.join(cures)}, as runs show"
        if ways and not able:
            return f"{' or '.join(ways)} may do: no run of {num_steps:,} steps was made"
        return "use a larger target"

    def refusal(self, reason: str, reachable: float = math.nan) -> StepAdvice:
        return StepAdvice(math.nan, 0, reachable, self.search.stability, self.floor, False, reason)
