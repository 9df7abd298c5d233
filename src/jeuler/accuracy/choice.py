"""advise_method: which method reaches an error in the least time on this machine."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Mapping
from typing import Any

import numpy as np

from jeuler._core import checks, trees
from jeuler._core.arguments import says_what_to_write
from jeuler._core.component import result
from jeuler._core.describe import table, text_table
from jeuler._core.precision import flat
from jeuler.accuracy.asked import Asked
from jeuler.accuracy.candidates import (
    Candidate,
    Problem,
    default_candidates,
    explicit_reference,
    given_candidates,
    stiff_reference,
)
from jeuler.accuracy.method import has_diffrax
from jeuler.accuracy.pilot import distance, norm
from jeuler.accuracy.trials import Found, Target, Trial, cheapest, milliseconds
from jeuler.accuracy.written import code_of
from jeuler.steps.explicit import VectorField

PyTree = Any

TRUST = 0.05  # the reference must be known to this part of the target
SHORT = 2e-2  # s that any run may take, and
SLOWER = 6.0  # times the fastest so far
FIRST = 1.0  # s, while there is none
CLOSE = 3.0  # times the fastest: timed again, in turns, as `solve` runs them
ROUNDS = 9
NOT_TRIED = "not tried: patience= would be over"
WITHOUT = 3.0  # times the patience, while no method has reached the target
HEAD = "method", "dt, s", "rtol", "steps", "seconds", "error", "reason"


@result
class RankedMethod:
    """One method in the ranking of `advise_method`.

    Attributes:
      name: of the method.
      step: the step, the diffrax solver, or None for `solve_adaptive` as it is.
      dt: step size, s; NaN for adaptive runs and for methods without an answer.
      num_steps: steps from t0 to t1, for adaptive runs those taken and rejected; 0 without an answer.
      rtol, atol: tolerances of adaptive runs; NaN else.
      seconds: predicted for one run on this machine, compiled; NaN without an answer.
      error: predicted at t1, in the terms of the target; without an answer the least that was seen.
      reason: whether a run of that setting was made, or it is predicted; or why there is no answer.
      code: the line that makes the run; empty without an answer.
    Example:
      >>> import jeuler
      >>> best = jeuler.advise_method(lambda t, y, args: -y, 1.0, t1=1.0, error=1e-3,
      ...     methods={"RK4": jeuler.rk4_step}).best
      >>> best.code
      "jeuler.solve(f, y0, dt=0.5, num_steps=2, save_every=2, step=methods['RK4'])"
    """

    name: str
    step: Any
    dt: float
    num_steps: int
    rtol: float
    atol: float
    seconds: float
    error: float
    reason: str
    code: str


@result
class MethodAdvice:
    """What `advise_method` found: the methods from the fastest to those that do not reach the target.

    Attributes:
      rows: a tuple of `RankedMethod`.
      target: the error asked for.
      reason: in one line, what to use, or why nothing is known to reach the target.
      reference_error: how far the state that errors are measured against is known, in the terms of the target; NaN
        without one.
      trial_seconds: what the advice itself took, compilation included, s.
    Example:
      >>> import jeuler
      >>> advice = jeuler.advise_method(lambda t, y, args: -y, 1.0, t1=1.0, error=1e-3,
      ...     methods={"Euler": jeuler.euler_step, "RK4": jeuler.rk4_step})
      >>> [(row.name, row.num_steps > 100) for row in advice.rows]
      [('RK4', False), ('Euler', True)]
      >>> advice.best.name, advice.best.error < 1e-3
      ('RK4', True)
    """

    rows: tuple[RankedMethod, ...]
    target: float
    reason: str
    reference_error: float
    trial_seconds: float

    @property
    def best(self) -> RankedMethod | None:
        """The fastest method that reaches the target; None if none does."""
        return self.rows[0] if self.rows and math.isfinite(self.rows[0].seconds) else None

    def __repr__(self) -> str:
        return text_table(self.reason, map(_cells, self.rows), HEAD)

    def to_markdown(self) -> str:
        """The ranking as a table, one line a method."""
        rows = [HEAD, ("---",) * len(HEAD), *map(_cells, self.rows)]
        return "\n".join("| " + " | ".join(row) + " |" for row in rows)

    def _repr_html_(self) -> str:
        best = self.best
        return table("MethodAdvice", map(_cells, self.rows), HEAD, f"{self.reason}. {best.code if best else ''}")


def _cells(row: RankedMethod) -> tuple[str, ...]:
    shown = lambda x, form: format(x, form) if math.isfinite(x) else "-"  # noqa: E731
    steps = f"{row.num_steps:,}" if row.num_steps else "-"
    return (
        row.name,
        shown(row.dt, ".3g"),
        shown(row.rtol, ".1e"),
        steps,
        shown(row.seconds, ".2e"),
        shown(row.error, ".1e"),
        row.reason,
    )


@says_what_to_write(dt="nothing: it finds dt", num_steps="nothing: it finds it", tolerance="error=...")
def advise_method(
    f: VectorField | Any,
    y0: PyTree,
    *,
    t1: float,
    error: float,
    t0: float = 0.0,
    args: PyTree = None,
    relative: bool = True,
    breaks: Any = (),
    methods: Mapping[str, Any] | None = None,
    patience: float = 60.0,
) -> MethodAdvice:
    """Which method reaches an error at t1 in the least time on this machine, from short timed runs of each.

        error = |y_method(t1) - y(t1)| / |y(t1)|,  Euclidean norms over all numbers of the state

    Each method runs as `solve`, `solve_adaptive` or ``diffrax.diffeqsolve`` would run it, in the precision of y0,
    keeping the last state only; seconds are those of a compiled run, the least of several. Its number of steps is
    doubled, or its tolerance tightened, until the error against an accurate adaptive run meets the target, and is then
    narrowed down. A method that would take longer than 6 times the fastest so far, and than 20 ms, is not run to the
    end: its dt and seconds are predicted by its order where the errors have been seen to follow it, and else it has
    none, with the reason. The methods within a factor 3 of the fastest are timed again at the end, in turns.

    The accurate run is that of `solve_adaptive` in float64 at two tolerances that agree to a twentieth of the target;
    for stiff equations, by an extrapolated linearly implicit step.

    Args:
      f: vector field, ``f(t, y, args) -> dy/dt``; or a `Scene`, and then y0 is its `ParticleState`: the advice is for
        its forces, and the reason names the effects that it leaves out.
      y0: initial state; its dtype is the precision advised for.
      t1: final time, s.
      error: target at t1, > 0.
      t0: initial time, s.
      args: passed to f.
      relative: the target is relative to the norm of the state at t1 (True; where that is 0 it is not), or in the units
        of the state (False).
      breaks: times at which f may jump, s, t0 and t1 among them, as `solve` and `solve_adaptive` take them.
      methods: ``{name: method}``, steps and diffrax solvers (by tolerance where they estimate their error), or None in
        place of a method for `solve_adaptive`; None takes all steps of the library and diffrax's Euler, Heun, Tsit5
        and Kvaerno5, if diffrax is installed.
      patience: seconds of trials and compilation after which no further method is begun; three times that while none
        has reached the target. The reason says how many were not tried.
    Returns: `MethodAdvice`; print it for the table.
    Raises: ValueError, naming the argument, what was expected and what came.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> oscillator = lambda t, y, args: (y[1], -y[0])
      >>> advice = jeuler.advise_method(oscillator, (1.0, 0.0), t1=5.0, error=1e-2,
      ...     methods={"symplectic Euler": jeuler.symplectic_euler_step, "Euler": jeuler.euler_step})
      >>> [row.name for row in advice.rows]
      ['symplectic Euler', 'Euler']

    Source: E. Hairer, S. Norsett, G. Wanner, Solving Ordinary Differential Equations I, 1993, sect. II.10 (comparison
      of methods by work against error).
    """
    begun = time.perf_counter()
    asked = Asked.of("advise_method", f, y0, t0=t0, t1=t1, args=args, error=error, relative=relative, breaks=breaks)
    checks.positive("patience", patience)
    problem = Problem(asked.f, asked.y0, asked.t0, asked.t1, asked.args, asked.breaks)
    candidates = (
        default_candidates(asked.f, asked.y0, asked.t0, asked.args)
        if methods is None
        else given_candidates(_checked(methods))
    )
    absent = methods is None and not has_diffrax()
    left_out = asked.left_out + ("; diffrax is not installed, so without its solvers" if absent else "")
    return _Ranking(problem, asked.error, relative, begun, float(patience), asked.name).advice(candidates, left_out)


def _checked(methods: Any) -> Mapping[str, Any]:
    """One ValueError if methods is not a dictionary of steps and solvers."""
    if not isinstance(methods, Mapping) or not methods:
        raise ValueError(f"methods must be a dict {{name: step or diffrax solver}}, got {checks.shown(methods)}")
    for name, method in methods.items():
        if not (
            method is None or callable(method) or (has_diffrax() and type(method).__module__.startswith("diffrax"))
        ):
            raise ValueError(
                f"methods[{name!r}] must be a step (f, t, y, dt, args) -> y or a diffrax solver, got "
                f"{checks.shown(method)}"
            )
        checks.refuse_class(f"methods[{name!r}] must be a step or a diffrax solver", method)
    return methods


class _Ranking:
    """Trials of the candidates on one problem."""

    def __init__(
        self, problem: Problem, error: float, relative: bool, begun: float, patience: float, scene: str
    ) -> None:
        self.problem, self.error, self.relative = problem, error, relative
        self.begun, self.patience, self.scene, self.size = begun, patience, scene, 1.0
        self.stiff = False
        self.dtype = np.dtype(trees.time_dtype(problem.y0))
        self.known: dict[tuple[str, Any], Trial] = {}

    def trial(self, candidate: Candidate, dtype: Any) -> Trial:
        """One a method and precision, so that nothing is compiled twice."""
        key = candidate.name, np.dtype(dtype)
        if key not in self.known:
            self.known[key] = Trial(candidate, self.problem, dtype)
        return self.known[key]

    @property
    def spent(self) -> float:
        """Seconds since the question was asked."""
        return time.perf_counter() - self.begun

    def advice(self, candidates: list[Candidate], left_out: str) -> MethodAdvice:
        final, known_to = self.reference()
        if final is None:
            reason = (
                "no method can be judged: adaptive runs of two tolerances do not agree to a twentieth of the target, "
                "or take too many steps; take a larger error, a shorter interval, or name the jumps of f in breaks="
            )
            rows = [self.row(c, Found(None, 0, math.nan, math.nan, "not judged")) for c in candidates]
            return MethodAdvice(tuple(rows), self.error, reason + left_out, math.nan, self.spent)
        found = self.run_all(candidates, final)
        rows = [self.row(candidate, found[candidate.name]) for candidate in candidates]
        rows.sort(key=lambda row: row.seconds if math.isfinite(row.seconds) else math.inf)
        advice = MethodAdvice(tuple(rows), self.error, "", known_to, 0.0)
        reason = self.in_one_line(advice.best, sum(row.reason == NOT_TRIED for row in rows), len(rows)) + left_out
        return dataclasses.replace(advice, reason=reason, trial_seconds=self.spent)

    def in_one_line(self, best: RankedMethod | None, not_tried: int, count: int) -> str:
        untried = f"; {not_tried} of {count} methods were not tried, as patience= was over: raise it"
        untried = untried if not_tried else ""
        if best is None:
            return f"no method tried reaches an error of {self.error:g}{untried}"
        how = f"rtol = {best.rtol:.1e}" if math.isfinite(best.rtol) else f"dt = {best.dt:.3g} s"
        steps = f"{best.num_steps:,} step{'s' * (best.num_steps != 1)}"
        return f"for an error of {self.error:g} use {best.name}, {how}, {steps}: {milliseconds(best.seconds)}{untried}"

    def scale(self, final: np.ndarray) -> float:
        return (norm(final) or 1.0) if self.relative else 1.0

    def reference(self) -> tuple[np.ndarray | None, float]:
        """The state at t1 by an adaptive run, where two tolerances agree; and by how much they do."""
        start = _size(flat(self.problem.y0))
        for candidate in (explicit_reference(), stiff_reference()):
            trial, before, size = self.trial(candidate, np.float64), None, _unit(start)
            rtol = min(1e-6, 0.01 * self.error)
            while rtol > 1e-14:
                final, _ = trial.final((rtol, rtol * size))
                if not np.all(np.isfinite(final)):
                    break
                if before is not None:
                    apart = distance(before, final) / self.scale(final)
                    if apart <= TRUST * self.error:
                        self.size = _unit(start, _size(final))
                        self.stiff = candidate.program_size > 0
                        return final, apart
                size = _unit(start, _size(final))
                before, rtol = final, rtol / 30
        return None, math.nan

    def run_all(self, candidates: list[Candidate], final: np.ndarray) -> dict[str, Found]:
        found: dict[str, Found] = {}
        fastest, explicit_compile = math.inf, 0.0
        if self.stiff:  # first those that are likely to be fast there
            candidates = sorted(candidates, key=lambda candidate: not candidate.program_size)
        for candidate in candidates:
            left = self.patience * (WITHOUT if math.isinf(fastest) else 1.0) - self.spent
            trial = self.trial(candidate, self.dtype)
            if left < (0.0 if trial.known else candidate.program_size * explicit_compile):
                found[candidate.name] = Found(None, 0, math.nan, math.nan, NOT_TRIED)
                continue
            seconds = FIRST if math.isinf(fastest) else max(SHORT, SLOWER * fastest)
            target = Target(self.error, final, self.scale(final), seconds, self.size)
            found[candidate.name] = best = self.judged(trial, target)
            if best.seconds < fastest:
                fastest = best.seconds
            if not candidate.program_size:
                explicit_compile = max(explicit_compile, trial.compile_seconds)
        return self.timed_again(candidates, found, fastest)

    def judged(self, trial: Trial, target: Target) -> Found:
        try:
            return cheapest(trial, target)
        except (RuntimeError, ValueError, TypeError) as failure:  # of a solver that this problem does not suit
            return Found(None, 0, math.nan, math.nan, f"failed: {str(failure).strip().splitlines()[0][:120]}")

    def timed_again(self, candidates: list[Candidate], found: dict[str, Found], fastest: float) -> dict[str, Found]:
        """The least of rounds in turns, so that a slow moment of the machine falls on all alike."""
        close = [c for c in candidates if found[c.name].seconds <= CLOSE * fastest and found[c.name].reason == "run"]
        trials = {c.name: self.trial(c, self.dtype) for c in close}
        runs = {name: trial.as_written(found[name].setting) for name, trial in trials.items()}
        least = {name: trial.seconds(runs[name], 1) * math.inf for name, trial in trials.items()}  # compiles
        for _ in range(ROUNDS):
            for name, trial in trials.items():
                least[name] = min(least[name], trial.seconds(runs[name], 1))
        again = {name: dataclasses.replace(found[name], seconds=seconds) for name, seconds in least.items()}
        return found | again

    def row(self, candidate: Candidate, found: Found) -> RankedMethod:
        problem, nan = self.problem, math.nan
        base = candidate.name, candidate.step
        if found.setting is None:
            return RankedMethod(*base, nan, 0, nan, nan, nan, found.error, found.reason, "")
        if candidate.adaptive:
            rtol, atol = found.setting
            dt = nan
        else:
            rtol = atol = nan
            dt = (problem.t1 - problem.t0) / found.setting
        code = code_of(candidate, problem, found.setting, found.num_steps, scene=self.scene)
        numbers = dt, found.num_steps, rtol, atol, found.seconds, found.error
        return RankedMethod(*base, *numbers, found.reason, code)


def _size(numbers: np.ndarray) -> float:
    """Root mean square."""
    return norm(numbers) / math.sqrt(numbers.size) if numbers.size else 0.0


def _unit(*sizes: float) -> float:
    """The smallest that is not 0; 1 if all are."""
    return min((size for size in sizes if size > 0), default=1.0)
