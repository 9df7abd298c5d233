"""The search behind advise_step: pilot runs of one problem, and the fewest steps that meet a target error."""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np

from jeuler._core import trees
from jeuler._core.precision import double_precision, flat
from jeuler.accuracy.known_end import Reference, find_reference, is_jump
from jeuler.accuracy.leading import LARGEST_ORDER, LeadingError
from jeuler.accuracy.patience import Patience
from jeuler.accuracy.pilot import Ladder, Pilot, distance, norm
from jeuler.accuracy.roundoff import Rounding
from jeuler.solving._breaks import SIDE
from jeuler.steps.explicit import Step, VectorField
from jeuler.steps.implicit import linearly_implicit_euler_step
from jeuler.steps.stability import Linearisation

PyTree = Any

AIM = 0.8  # of the target: an answer errs on the side of accuracy
NEAR = 0.75  # of the aim: an error between this and the aim ends the search
FACTOR = 3.0  # an error within this factor of the target is near it
MARGIN = 0.01  # by which dt may be larger with the error still near the target
FINENESS = 1e-3  # part of the number of steps below which the search makes no difference
TRUST = 0.1  # the extrapolated state must be known to this part of the error it judges
REGULAR = 0.25  # and the observed order be this close to the step's own, to predict beyond the pilots
OFF = 0.93, 0.79, 0.61  # parts of the finest rung: numbers of steps that share no pattern with it
NONE = 1e-3  # part of the target that is no error
EVEN = 2.5  # times the error that the order of the step tells of them
NEAR_ENOUGH = 4  # an answer of up to this part of the longest pilot run is run itself, not predicted
DOUBLINGS = 64  # times the steps that stability asks for, to see how the error falls from there on
ROUGH = 2**18  # steps of the longest run in float32
ROUGHEST = 1e-30  # an end below this sinks under the numbers of float32, whose runs then say nothing of roundoff
FOLLOWS = 0.05  # part of an error by which the end of a run may miss that of the modified equation
TINY = 1e-290  # a final state below this has no scale of its own


class Search:
    """Pilot runs of one step on one problem, looking for the fewest steps whose error meets the target."""

    f: VectorField
    start: PyTree
    t0: float
    t1: float
    args: PyTree
    step: Step
    error: float
    relative: bool
    compensated: bool
    planned: int  # steps of the longest pilot run
    ceiling: int  # of one where stability asks for so many
    breaks: tuple[float, ...]
    patience: Patience
    seen: dict[int, np.ndarray]  # the ends of the runs of the ladder
    disagreeing: bool  # whether adaptive runs came to different ends
    vanishing: bool  # whether the end is 0 but for roundoff, so that no error is relative to it
    interval: float
    order: int
    dtype: Any
    linear: Linearisation
    pilot: Pilot
    stability: float
    bound: float

    def __init__(
        self,
        f: VectorField,
        y0: PyTree,
        t0: float,
        t1: float,
        args: PyTree,
        step: Step,
        error: float,
        *,
        relative: bool,
        compensated: bool,
        most: int,
        patience: Patience,
        ceiling: int = 0,
        breaks: tuple[float, ...] = (),
    ) -> None:
        self.patience, self.seen = patience, {}
        self.f, self.start, self.t0, self.t1, self.args, self.step = f, y0, t0, t1, args, step
        self.error, self.relative, self.compensated = error, relative, compensated
        self.planned, self.ceiling = most, max(most, ceiling)
        self.breaks, self.disagreeing, self.vanishing = breaks, False, False
        self.interval = t1 - t0
        self.order = int(getattr(step, "order", 1))
        self.dtype = np.dtype(trees.time_dtype(y0))
        with double_precision():
            self.linear = Linearisation(f, y0, args)
        self.pilot = self.runs(step, np.float64, compensated)
        self.stability = math.inf  # largest stable dt
        self.bound = math.inf  # largest dt whose instability, if any, stays small until t1
        self.look_at_stability(flat(y0)[None], np.array([t0]))

    def runs(self, step: Step, dtype: Any, compensated: bool, breaks: tuple[float, ...] | None = None) -> Pilot:
        breaks = self.breaks if breaks is None else breaks
        return Pilot(self.f, self.start, self.t0, self.t1, self.args, step, dtype, compensated, breaks)

    def jumps_at(self, end: float, inside: int, final: Any) -> bool:
        """Whether f at an end of the interval is not what it is just inside: after it for +1, before it for -1."""
        beside = end + inside * SIDE * float(np.finfo(float).eps) * max(abs(self.t0), abs(self.t1))
        return is_jump(self.f, self.start, None if inside > 0 else final, self.args, (end, beside))

    @property
    def most(self) -> int:
        """Steps of the longest pilot run: more than planned where a few doublings of what stability asks for are."""
        if not self.bound > 0:
            return self.planned
        return int(min(self.ceiling, max(self.planned, DOUBLINGS * self.interval / self.bound)))

    def scale(self, final: Any) -> float:
        """The unit of the target, in the units of the state."""
        size = norm(final)
        return size if self.relative and not self.vanishing and not size < TINY else 1.0

    def target(self, ladder: Ladder) -> float:
        """The target in the units of the state."""
        return self.error * self.scale(ladder.best)

    def look_at_stability(self, states: np.ndarray, times: np.ndarray) -> None:
        """Narrow the limits by the spectra at these states."""
        with double_precision():
            for state, t in zip(states, times, strict=True):
                try:
                    limit, bound = self.linear.limits(t, state, self.step, interval=self.interval)
                except (ValueError, TypeError, np.linalg.LinAlgError):
                    continue  # a Jacobian that is not finite; the pilots will show what happens there
                self.stability, self.bound = min(self.stability, limit), min(self.bound, bound)

    def confirmed(self, start: int) -> tuple[Ladder | None, bool]:
        """The ladder from so many steps on, as far as it was climbed, and whether it is even.

        Errors that are only predicted, from runs too coarse to bear the checks, are looked at again on finer ones.
        """
        ladder = self.climb(start)
        while ladder is not None and not self.even(ladder):
            if ladder.errors()[-1] <= self.target(ladder):
                return ladder, False
            finer = self.climb(2 * ladder.num_steps[-1], ladder)
            if finer is None:
                return ladder, False
            ladder = finer
        return ladder, ladder is not None

    def climb(self, num_steps: int, ladder: Ladder | None = None) -> Ladder | None:
        """Double the steps until the finest run's error is known, and meets the target or follows the order."""
        ladder, looked = Ladder(self.order) if ladder is None else ladder, False
        while not self.patience.over and (
            num_steps <= self.most or (num_steps <= self.ceiling and self._falling(ladder))
        ):
            states = self.pilot(num_steps)
            self.seen[num_steps] = states[-1]
            ladder.add(num_steps, states[-1])
            if len(ladder.finals) >= 4 and self._trusted(ladder):
                if not looked:
                    looked = True
                    times = self.t0 + self.interval * np.arange(1, len(states) + 1) / len(states)
                    self.look_at_stability(states[::2], times[::2])
                own_run = 0 if self.patience.over else self.most // NEAR_ENOUGH
                far = self._regular(ladder) and self.predicted(ladder)[0] > own_run
                if ladder.errors()[-1] <= self.target(ladder) or far:
                    return ladder
            num_steps *= 2
        return None

    def _falling(self, ladder: Ladder) -> bool:
        """Whether the last errors begin to fall as the order says, so that a few runs more may show it."""
        return len(ladder.finals) >= 4 and bool(np.all(ladder.observed_orders()[-2:] > 0.5 * self.order))

    def _trusted(self, ladder: Ladder) -> bool:
        """Whether the extrapolated state is known well enough, now and one run before, to judge the target."""
        if ladder.best is None or not np.all(np.isfinite(ladder.best)):
            return False
        target, error = self.target(ladder), ladder.errors()[-1]
        converged = error <= 1e-13 * norm(ladder.best)
        falling = np.all(ladder.observed_orders()[-2:] > 0.5 * self.order) or converged
        return target > 0 and falling and ladder.doubt <= TRUST * max(target, error)

    def _regular(self, ladder: Ladder) -> bool:
        """Whether the last errors fall as the order says, so that finer ones may be predicted."""
        orders = ladder.observed_orders()[-3:]
        return bool(np.all(np.abs(orders - self.order) < REGULAR)) and ladder.doubt <= TRUST * ladder.errors()[-1]

    def predicted(self, ladder: Ladder) -> tuple[int, float]:
        """Steps beyond the pilots that the order of the step and the stability at the sampled states ask for,
        and the error to expect of them."""
        error = float(ladder.errors()[-1])
        more = (error / (AIM * self.target(ladder))) ** (1 / self.order)
        num_steps = max(math.ceil(ladder.num_steps[-1] * more), math.ceil(self.interval / self.bound))
        return num_steps, error * (ladder.num_steps[-1] / num_steps) ** self.order

    def fewest(self, ladder: Ladder) -> tuple[int, float]:
        """The fewest steps that meet the aim and stand on firm ground, by bisection on runs; and their error.

        Between the coarsest rung from which on all meet the aim, and the rung before. Firm ground: with dt 1 %
        larger the error is still within a factor 3 of the target, so no run balances on the edge of instability.
        """
        aim, near = AIM * self.target(ladder), FACTOR * self.target(ladder)
        spent = 0

        def error_of(num_steps: int) -> float:
            nonlocal spent
            spent += num_steps
            return ladder.error_of(self.pilot(num_steps)[-1])

        def firm(num_steps: int) -> bool:
            fewer = math.ceil(num_steps * (1 - MARGIN))
            return (low <= fewer and error_low <= near) or error_of(fewer) <= near

        errors = ladder.errors()
        rung = len(errors) - 1
        while rung > 0 and errors[rung - 1] <= aim:
            rung -= 1
        high, error_high = ladder.num_steps[rung], float(errors[rung])
        low, error_low = (ladder.num_steps[rung - 1], float(errors[rung - 1])) if rung else (high // 2, math.inf)
        while not rung and high > 1 and (error := error_of(high // 2)) <= aim:  # fewer than the ladder begins with
            high, error_high, low = high // 2, error, high // 4
        if not firm(high):
            low, error_low = high, math.inf
            high *= 2
            error_high = error_of(high)
        while (
            error_high < NEAR * aim
            and high - low > max(1, FINENESS * high)
            and spent < max(8 * self.planned, 2 * self.most)
            and not self.patience.over
        ):
            part = 0.5
            if math.isfinite(error_low):  # log-log interpolation, kept off the ends
                part = math.log(error_low / (0.93 * aim)) / math.log(error_low / error_high)
                part = min(max(part, 0.02), 0.98)
            middle = min(max(round(low * (high / low) ** part), low + 1), high - 1)
            error = error_of(middle)
            if error <= aim and firm(middle):
                high, error_high = middle, error
            else:
                low, error_low = middle, error if error > aim else math.inf
        return high, error_high

    def even(self, ladder: Ladder) -> bool:
        """Whether an adaptive run ends where the ladder does, and runs off the ladder have the errors that it tells.

        Where f jumps, rungs that are powers of two may all meet the jumps alike, and agree on a wrong state.
        """
        finest, error = ladder.num_steps[-1], float(ladder.errors()[-1])
        known = 2 * TRUST * max(self.target(ladder), error)
        if self.reference is None:
            if self.disagreeing:
                return False
        elif ladder.error_of(self.reference.final) > known:
            return False
        floor = 1e-12 * norm(ladder.finals[-1]) + 2 * ladder.doubt + NONE * self.target(ladder)
        for part in OFF:
            num_steps = round(part * finest)
            expected = error * (finest / num_steps) ** self.order
            if ladder.error_of(self.pilot(num_steps)[-1]) > EVEN * expected + floor:
                return False
        return True

    @functools.cached_property
    def reference(self) -> Reference | None:
        """An adaptive run that is known well enough to judge the target."""
        tolerance, most = TRUST * self.error, max(256, self.planned // 8)
        problem = self.f, self.start, self.t0, self.t1, self.args, self.breaks
        scale = lambda end: 1.0 if end is None else self.scale(end)  # noqa: E731
        over = lambda: self.patience.over  # noqa: E731
        known, self.disagreeing = find_reference(problem, most, lambda end: tolerance * scale(end), over)
        self.vanishing = known is not None and known.vanishes
        return known

    def by_leading_term(self, known: Reference) -> tuple[int, float, int] | None:
        """Steps far beyond the pilots, their error, and those of a pilot run that bears it out.

        The error is that of the modified equation, which the step follows but for terms of one order more. It is
        believed where a pilot run ends where that equation does: within a twentieth of the error there.
        """
        if self.order > LARGEST_ORDER or self.breaks or self.patience.over:
            return None
        aim, seen = AIM * self.error * self.scale(known.final), self.most
        with double_precision():
            ends = LeadingError(self.f, self.start, self.t0, self.t1, self.args, self.step, known.step)
            exact = ends(0.0)
            error_of = lambda n: distance(ends(self.interval / n), exact)  # noqa: E731
            if not distance(exact, known.final) <= TRUST * aim or self.patience.over:
                return None
            while not distance(self.pilot(seen)[-1], ends(self.interval / seen)) <= FOLLOWS * error_of(seen):
                seen *= 2
                if seen > self.ceiling or self.patience.over:
                    return None
            num_steps = seen
            for _ in range(8):
                error = error_of(num_steps)
                if NEAR * aim <= error <= aim:
                    return num_steps, error, seen
                if not np.isfinite(error) or self.patience.over:
                    return None
                num_steps = math.ceil(num_steps * (error / (0.95 * aim)) ** (1 / self.order))
        return None

    def error_after(self, num_steps: int, final: np.ndarray) -> float:
        """Error of a run in terms of the target; inf where it is not finite."""
        error = distance(self.pilot(num_steps)[-1], final) / self.scale(final) / self.error
        return error if math.isfinite(error) else math.inf

    def meets(self, num_steps: int, final: np.ndarray, dtype: Any, compensated: bool) -> bool:
        """Whether a run of the step in this precision meets the target."""
        end = self.runs(self.step, dtype, compensated)(num_steps)[-1]
        return distance(end, final) <= self.error * self.scale(final)

    def implicit_steps(self, final: np.ndarray, fewer_than: int) -> int | None:
        """How many linearly implicit Euler steps meet the aim, a power of two, found by runs; None if not that few."""
        return self.steps_of(linearly_implicit_euler_step, final, min(fewer_than, self.planned // 64))

    def steps_of(self, step: Step, final: np.ndarray, fewer_than: int, dtype: Any = np.float64) -> int | None:
        """How many of these steps meet the aim, a power of two, found by runs; None if not so few."""
        run, aim = self.runs(step, dtype, False), AIM * self.error * self.scale(final)
        num_steps, met = 1, False
        while num_steps < fewer_than and not self.patience.over:
            before, met = met, distance(run(num_steps)[-1], final) <= aim
            if before and met:  # twice running: no accident
                return num_steps // 2
            num_steps *= 2
        return None

    def rounding(self, ladder: Ladder) -> Rounding:
        """Roundoff against steps, in the terms of the target and the precision of y0.

        Measured as the difference between runs in float32 and in float64; for a y0 in float32 at the steps where
        its error is least, for one in float64 (out of reach) carried over by the ratio of the two eps.
        """
        rough, scale = self.runs(self.step, np.float32, self.compensated), self.scale(ladder.best)
        if self.dtype == np.float64 and scale < ROUGHEST:
            return Rounding(float(np.finfo(float).eps), 0.5)
        carried = float(np.finfo(self.dtype).eps / np.finfo(np.float32).eps) / scale
        known = dict(zip(ladder.num_steps, ladder.finals, strict=True))

        def fitted(counts: list[int]) -> Rounding:
            pairs = ((rough(n)[-1], known[n] if n in known else self.pilot(n)[-1]) for n in counts)
            return Rounding.fitted(counts, [carried * distance(*pair) for pair in pairs], self.compensated)

        counts = [n for n in ladder.num_steps if n <= ROUGH][-4:] or [ROUGH]
        law = fitted(counts)
        truncation = ladder.errors()[-1] / scale * ladder.num_steps[-1] ** self.order
        turn = min(law.floor(truncation, self.order)[1], ROUGH)
        if self.dtype == np.float32 and turn > counts[-1]:
            law = fitted([int(n) for n in np.geomspace(turn / 8, turn, 6)])
        return law
