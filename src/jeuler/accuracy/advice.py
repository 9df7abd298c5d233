"""advise_step: the dt that a target error needs, or why there is none."""

from __future__ import annotations

import dataclasses
from typing import Any

from jeuler._core import checks
from jeuler._core.arguments import says_what_to_write
from jeuler._core.precision import flat
from jeuler.accuracy.answer import Answer, StepAdvice, is_explicit
from jeuler.accuracy.asked import Asked
from jeuler.accuracy.patience import Patience
from jeuler.accuracy.search import Search
from jeuler.steps.explicit import Step, VectorField, euler_step

PyTree = Any

PILOT_WORK = 2**25  # numbers advanced in the longest pilot run
IMPLICIT_WORK = 16  # times the work of an explicit step that of one which solves equations is taken to be
LONGER = 8  # times that work where stability asks for it


@says_what_to_write(dt="nothing: it finds dt", num_steps="nothing: it finds it", tolerance="error=...")
def advise_step(
    f: VectorField | Any,
    y0: PyTree,
    *,
    t1: float,
    error: float,
    t0: float = 0.0,
    args: PyTree = None,
    step: Step = euler_step,
    relative: bool = True,
    compensated: bool = False,
    breaks: Any = (),
    max_pilot_steps: int | None = None,
    patience: float = 120.0,
) -> StepAdvice:
    """The largest dt whose error at t1 meets a target, from pilot runs; or a reason why no dt does.

        error = |y_dt(t1) - y(t1)| / |y(t1)|,  Euclidean norms over all numbers of the state

    Pilot runs with 16, 32, 64, ... steps are extrapolated to dt = 0 (Richardson). Their errors against that
    state give the dt, and further runs confirm it: at that dt, and at one 1 % larger, whose error must still be
    within a factor 3 of the target, so that no answer balances on the edge of instability. Where that leaves an
    error far below the target, the reason says why: one step fewer would miss it, or stability sets dt, and how few
    implicit steps would do. Finer targets than the pilots reach are predicted by the order of the step, where the
    errors have been seen to follow it. Pilots run in float64 whatever the precision of y0.

    Where f jumps, pilots with 16, 32, 64, ... steps may all meet the jumps alike and agree on a wrong state. So the
    extrapolated state must also be that of an adaptive run, and runs with 0.93, 0.79 and 0.61 of the steps must have
    the errors that the order tells of them. Where they have not, numbers of steps 2 to 10 % apart are run in turn, and
    the answer is the first whose own run meets the target, with runs 1.5 and 3 % beside it within a factor 3; or, where
    that is an accident of the grid that the jumps fall on, the first of up to three times as many that is near it. If
    only an error far below the target was found, up to 400 numbers of steps are run from half as many on: the first
    near the target is taken, or else the fewest that meet it.

    Where no pilot is fine enough to follow its order, as with Euler steps on an orbit near its centre, the leading term
    of the error of a step of order 1 or 2 is added to the equation. An adaptive run of that says the error at any dt;
    it is believed if it ends where a pilot run does, within a twentieth of the error there.

    The roundoff floor is measured on runs in float32 beside those in float64. For a y0 in float32 it was within a
    factor 3 of the floor that runs show in 36 of 37 cases (seven problems, three steps, plain and compensated) and 5 in
    the last; for one in float64 it is carried over by the ratio of the two eps, and an order of magnitude. Never more
    steps are counted on than the integer clock can count, 2^31 - 1.

    Args:
      f: vector field, ``f(t, y, args) -> dy/dt``; or a `Scene`, and then y0 is its `ParticleState`: the advice is for
        its forces, and the reason names the effects that it leaves out.
      y0: initial state; its dtype is the precision advised for.
      t1: final time, s.
      error: target at t1, > 0.
      t0: initial time, s.
      args: passed to f.
      step: the method.
      relative: the target is relative to the norm of the state at t1 (True; where that is 0 but for
        roundoff it is not, and the reason says so), or in the units
        of the state (False).
      compensated: advise for compensated sums.
      breaks: times at which f may jump, s, t0 and t1 among them, for a run with the same `solve(..., breaks=)`.
      max_pilot_steps: longest pilot run; None takes 2^25 over the numbers in the state, a second or so of work, a
        sixteenth of that for steps that solve equations, and never less than 4,096; or 64 times the steps that
        stability asks for, up to 8 times as many.
      patience: seconds after which no further run is begun; the one that goes on then is at most twice as long as the
        one before. What was found until then is answered, or the reason says that patience was over.
    Returns: `StepAdvice`; it refuses, ``feasible=False`` with the reason, rather than guess.
    Raises: ValueError, naming the argument, what was expected and what came.
    Example:
      >>> import jeuler
      >>> advice = jeuler.advise_step(lambda t, y, args: -y, 1.0, t1=1.0, error=1e-3)
      >>> advice.feasible, advice.num_steps
      (True, 626)

    Source: L. F. Richardson, The deferred approach to the limit, Phil. Trans. R. Soc. A 226, 1927; P. Henrici, Discrete
      Variable Methods in Ordinary Differential Equations, 1962, sect. 1.4 (roundoff).
    """
    checks.positive("patience", patience)
    patient = Patience(patience)
    asked = Asked.of("advise_step", f, y0, t0=t0, t1=t1, args=args, error=error, relative=relative, breaks=breaks)
    checks.function("step", step, "(f, t, y, dt, args) -> y", "pass, say, jeuler.euler_step")
    checks.true_or_false("compensated", compensated)
    longer = 1
    if max_pilot_steps is None:
        longer = LONGER
        work = PILOT_WORK if is_explicit(step) else PILOT_WORK // IMPLICIT_WORK
        max_pilot_steps = max(4096, work // max(1, flat(asked.y0).size))
    max_pilot_steps = checks.count("max_pilot_steps", max_pilot_steps, least=64)
    search = Search(
        asked.f,
        asked.y0,
        asked.t0,
        asked.t1,
        asked.args,
        step,
        asked.error,
        relative=relative,
        compensated=compensated,
        most=max_pilot_steps,
        patience=patient,
        ceiling=longer * max_pilot_steps,
        breaks=asked.breaks,
    )
    advice = Answer(search).advice()
    return dataclasses.replace(advice, reason=advice.reason + asked.left_out)
