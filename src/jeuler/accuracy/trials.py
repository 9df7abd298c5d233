"""Timed trial runs of one method on one problem, and the cheapest of its settings that meets a target error."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jeuler._core.component import Function
from jeuler._core.precision import cast, flat, precision
from jeuler._jax import programs
from jeuler.accuracy.candidates import Candidate, Problem, program, written_out
from jeuler.accuracy.method import is_diffrax
from jeuler.accuracy.pilot import distance, norm
from jeuler.accuracy.roundoff import COUNTER

AIM = 0.95  # of the target, that the cheapest run is to meet
NEAR = 0.75  # of the target: an error above it ends the search between two numbers of steps
FINE = 0.03  # part of the number of steps at which that search ends too
BESIDE = 0.97, 1.03  # parts of a number of steps whose errors must be within a factor 3: no accident
FACTOR = 3.0
REGULAR = 0.35  # the observed order must be as near to that of the method to predict by it
LOOSEST = 0.1  # rtol
SMALL = 1.0, 1e-4  # parts of the state in atol; the second for stiff equations, where small components decide
REPEATED = 2e-3  # s: a shorter run is timed several times


@dataclasses.dataclass(frozen=True)
class Outcome:
    """One run: its setting (the number of steps, or rtol and atol), the steps it took, its error and its seconds."""

    setting: Any
    num_steps: int
    error: float
    seconds: float


@dataclasses.dataclass(frozen=True)
class Found:
    """The cheapest setting that was found, run or predicted; or, with setting None, why there is none."""

    setting: Any
    num_steps: int
    error: float
    seconds: float
    reason: str


class Trial:
    """Runs of one method on one problem in one precision, each made once; compiled at the first."""

    candidate: Candidate
    problem: Problem
    dtype: Any
    compile_seconds: float
    known: dict[Any, Outcome]

    def __init__(self, candidate: Candidate, problem: Problem, dtype: Any) -> None:
        self.candidate, self.problem, self.dtype = candidate, problem, np.dtype(dtype)
        self.compile_seconds, self.known = 0.0, {}

    def compiled_for(self, run: Any) -> Any:
        """``(setting) -> result`` of ``run(y0, args, t0, t1, setting)``, by a program of before if one fits."""
        p = self.problem
        with precision(self.dtype):
            times = [jnp.asarray(t, self.dtype) for t in (p.t0, p.t1)]
            given = cast(p.y0, self.dtype), cast(p.args, self.dtype), *times
            return functools.partial(programs.prepared(_run, (Function(run), *given)), None)

    @functools.cached_property
    def program(self) -> Any:
        return self.compiled_for(program(self.candidate, self.problem))

    def as_written(self, setting: Any) -> Any:
        """``() -> result``: the run as the user will make it, compiled for its number of steps."""
        if self.candidate.adaptive or is_diffrax(self.candidate.step):
            with precision(self.dtype):
                run = functools.partial(self.program, self.setting(setting))
        else:
            run = self.compiled_for(written_out(self.candidate, self.problem, setting))
        return run

    def setting(self, setting: Any) -> Any:
        if self.candidate.adaptive:
            return tuple(jnp.asarray(x, self.dtype) for x in setting)
        return jnp.int32(setting)

    def final(self, setting: Any) -> tuple[np.ndarray, int]:
        """The state at t1 and the steps taken."""
        with precision(self.dtype):
            y, num_steps = self.program(self.setting(setting))
            return flat(y), int(num_steps)

    def seconds(self, run: Any, repeats: int) -> float:
        """The least of so many runs."""
        least = math.inf
        with precision(self.dtype):
            for _ in range(repeats):
                begun = time.perf_counter()
                jax.block_until_ready(run())
                least = min(least, time.perf_counter() - begun)
        return least

    def again(self, setting: Any, repeats: int) -> float:
        with precision(self.dtype):
            return self.seconds(functools.partial(self.program, self.setting(setting)), repeats)

    def outcome(self, setting: Any, truth: np.ndarray, scale: float) -> Outcome:
        """The run at a setting, timed."""
        if setting not in self.known:
            if not self.known:
                self.compiled(setting)
            begun = time.perf_counter()
            final, num_steps = self.final(setting)
            seconds = time.perf_counter() - begun
            if seconds < REPEATED:
                seconds = self.again(setting, 5)
            error = distance(final, truth) / scale
            self.known[setting] = Outcome(setting, num_steps, error if math.isfinite(error) else math.inf, seconds)
        return self.known[setting]

    def slower_than(self, outcome: Outcome, seconds: float) -> bool:
        """Whether the run takes longer; looked at again if it seems so, as the machine may do other things beside."""
        if outcome.seconds > seconds:
            again = self.again(outcome.setting, 5 if outcome.seconds < 0.1 else 1)
            outcome = dataclasses.replace(outcome, seconds=min(again, outcome.seconds))
            self.known[outcome.setting] = outcome
        return outcome.seconds > seconds

    def compiled(self, setting: Any) -> None:
        """Compile, by a run that is short where it can be."""
        begun = time.perf_counter()
        self.final(setting if self.candidate.adaptive else 1)
        self.compile_seconds = time.perf_counter() - begun


def _run(run: Function, y0: Any, args: Any, t0: Any, t1: Any, _: None, *setting: Any) -> Any:
    """What is compiled; nothing is passed for the memory that it may take."""
    return run.function(y0, args, t0, t1, *setting)


@dataclasses.dataclass(frozen=True)
class Target:
    """What to reach: an error, relative to a scale, against a state; within so many seconds a run."""

    error: float
    truth: np.ndarray
    scale: float
    seconds: float
    size: float  # of the state: atol is rtol times this, or a small part of it


def cheapest(trial: Trial, target: Target) -> Found:
    """The cheapest setting of a method that meets the target."""
    if not trial.candidate.adaptive:
        return fewest(trial, target)
    found = [loosest(trial, target, part) for part in (SMALL if trial.candidate.program_size else SMALL[:1])]
    return min(found, key=lambda each: each.seconds if math.isfinite(each.seconds) else math.inf)


def fewest(trial: Trial, target: Target) -> Found:
    """The fewest equal steps, by doubling and bisection; predicted by the order where runs would take too long."""

    def run(num_steps: int) -> Outcome:
        return trial.outcome(num_steps, target.truth, target.scale)

    def meets(outcome: Outcome) -> bool:
        beside = (max(1, round(outcome.setting * part)) for part in BESIDE)
        return outcome.error <= AIM * target.error and all(run(n).error <= FACTOR * target.error for n in beside)

    runs = [run(1)]
    while not meets(runs[-1]):
        if stuck(runs, trial.dtype):
            return nothing(runs, f"roundoff in {trial.dtype} leaves an error of {runs[-1].error:.1e}")
        if trial.slower_than(runs[-1], target.seconds / 2) or 2 * runs[-1].setting > COUNTER:
            return predicted([trial.known[r.setting] for r in runs], trial, target)
        runs.append(run(2 * runs[-1].setting))
    high, low = runs[-1], runs[-2] if len(runs) > 1 else runs[-1]
    while high.error < NEAR * target.error and high.setting - low.setting > max(1, FINE * high.setting):
        part = 0.5
        if math.isfinite(low.error) and low.error > high.error:  # log-log interpolation, kept off the ends
            part = math.log(low.error / (0.85 * target.error)) / math.log(low.error / high.error)
            part = min(max(part, 0.05), 0.95)
        middle = round(low.setting * (high.setting / low.setting) ** part)
        middle = run(min(max(middle, low.setting + 1), high.setting - 1))
        if meets(middle):
            high = middle
        else:
            low = middle if middle.error > target.error else dataclasses.replace(middle, error=math.inf)
    return Found(high.setting, high.num_steps, high.error, high.seconds, "run")


def stuck(runs: list[Outcome], dtype: np.dtype) -> bool:
    """Whether the error has stopped falling where roundoff may be what is left."""
    last = [run.error for run in runs[-4:]]
    eps = float(np.finfo(dtype).eps)
    return len(last) == 4 and max(last) < 1e6 * eps and min(last[2:]) > 0.7 * min(last[:2])


def predicted(runs: list[Outcome], trial: Trial, target: Target) -> Found:
    """Beyond the longest run: by the order of the method, if the last errors fall as it says."""
    last, order = runs[-1], trial.candidate.order
    spent = f"up to {last.setting:,} steps, {milliseconds(last.seconds)}"
    if not math.isfinite(last.error):
        return nothing(runs, f"unstable in all runs {spent}; longer ones are not worth their time")
    pairs = itertools.pairwise(runs[-3:])
    falls = [math.log2(a.error / b.error) if b.error > 0 else math.inf for a, b in pairs]
    if len(falls) < 2 or any(abs(fall - order) > REGULAR for fall in falls):
        return nothing(runs, f"an error of {last.error:.1e} in runs {spent}; longer ones are not worth their time")
    more = (last.error / (AIM * target.error)) ** (1 / order)
    num_steps = math.ceil(last.setting * more)
    if num_steps > COUNTER:
        return nothing(runs, f"asks for {num_steps:.1e} steps, more than the clock can count")
    roundoff = 0.5 * float(np.finfo(trial.dtype).eps) * math.sqrt(num_steps)
    if roundoff * norm(target.truth) / target.scale > target.error:
        return nothing(runs, f"asks for {num_steps:,} steps, whose roundoff in {trial.dtype} is above the target")
    error = last.error * (last.setting / num_steps) ** order
    return Found(num_steps, num_steps, error, last.seconds * num_steps / last.setting, "predicted by its order")


def nothing(runs: list[Outcome], reason: str) -> Found:
    return Found(None, 0, min(run.error for run in runs), math.nan, reason)


def loosest(trial: Trial, target: Target, part: float) -> Found:
    """The loosest tolerance that meets the target: tightened by factors of 4, then once loosened by 2."""

    def run(rtol: float) -> Outcome:
        tolerances = tuple(float(f"{x:.3g}") for x in (rtol, rtol * part * target.size))
        return trial.outcome(tolerances, target.truth, target.scale)

    def meets(outcome: Outcome) -> bool:
        return outcome.error <= AIM * target.error and run(outcome.setting[0] / 1.5).error <= FACTOR * target.error

    runs = [run(LOOSEST)]
    while not meets(runs[-1]):
        last, tried = runs[-1], f"at rtol {runs[-1].setting[0]:.1e}"
        if last.num_steps >= trial.problem.max_steps(trial.candidate):
            return nothing(runs, f"more than {last.num_steps:,} steps {tried}")
        if stuck(runs, trial.dtype) or last.setting[0] < 16 * float(np.finfo(trial.dtype).eps):
            return nothing(runs, f"roundoff in {trial.dtype} leaves an error of {last.error:.1e}")
        if trial.slower_than(last, target.seconds):
            spent = f"{milliseconds(trial.known[last.setting].seconds)} {tried}"
            return nothing(runs, f"an error of {last.error:.1e} in {spent}; more is not worth its time")
        runs.append(run(last.setting[0] / 4))
    best = runs[-1]
    if len(runs) > 1 and meets(between := run(2 * best.setting[0])):
        best = between
    return Found(best.setting, best.num_steps, best.error, best.seconds, "run")


def milliseconds(seconds: float) -> str:
    return f"{1e3 * seconds:.3g} ms" if seconds < 1 else f"{seconds:.3g} s"
