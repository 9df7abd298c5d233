"""advise_step on published initial value problems: achieved error against target, for each (problem, target).

    python benchmarks/step_advice.py ../shared/reference/ode_problems.json [part of a name]

The error is relative, |y - reference| / |reference| at t1, for `euler_step` in float64. Every answer is run that
advances at most 1e10 numbers; one, of 410 million steps of 28 numbers, is not: it would take ten minutes or more. Where
the error is less than a third of the target, larger dts are run too, 1,000 of them over the first 10 % and 500 up to
the whole interval. One of them would have done if it meets the target, also with y0 moved by 1e-13 of itself, and comes
within a factor 3 with dt 1 % larger: all else balances on the edge of instability.
"""

import collections
import math
import pathlib
import sys
import time

import jax
import numpy as np
from arguments import REQUIRED, arguments

import jeuler
from jeuler.accuracy.pilot import Pilot, distance

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parent.parent / "tests"))
from published import problems_in

LONGEST = 1e10  # numbers advanced in a run, steps times the size of the state


class Runs:
    """Relative errors of runs of one problem, each made once."""

    def __init__(self, problem, moved=0.0):
        y0 = problem.y0 * (1 + moved)
        self.run = Pilot(problem.f, y0, problem.t0, problem.t1, None, jeuler.euler_step, float, False)
        self.reference = problem.reference
        self.known = {}

    def __call__(self, num_steps):
        if num_steps not in self.known:
            error = distance(self.run(num_steps)[-1], self.reference) / np.linalg.norm(self.reference)
            self.known[num_steps] = error if math.isfinite(error) else math.inf
        return self.known[num_steps]


def larger_steps(runs, moved, num_steps, target):
    """Whether a dt larger than the advised one would do, and in words how many come near the target and hold there."""
    parts = np.concatenate([np.linspace(1, 0.9, 1001), np.geomspace(0.9, 1 / num_steps, 500)])
    counts = [int(n) for n in np.unique(np.round(num_steps * parts))[::-1] if n < num_steps]
    near = [n for n in counts if target / 3 <= runs(n) <= 3 * target]
    if not near:
        return False, f"none of {len(counts):,} larger dts has an error within a factor 3 of the target"
    one_percent_more = {n: runs(math.ceil(0.99 * n)) / target for n in near}
    apart = max(max(moved(n) / runs(n), runs(n) / moved(n)) for n in near)
    hold = [n for n in near if max(runs(n), moved(n)) <= target and one_percent_more[n] <= 3]
    return bool(hold), (
        f"of {len(counts):,} larger dts {len(near)} come within a factor 3 of the target, in a window of "
        f"{(near[0] - near[-1] + 1) / near[0]:.2%} of dt; {len(hold)} meet it and hold: with dt 1 % larger the error "
        f"is up to {max(one_percent_more.values()):.1e} times the target; with y0 moved it changes {apart:.2g} times"
    )


def main(path, part=""):
    jax.config.update("jax_enable_x64", True)
    problems = {name: problem for name, problem in problems_in(path).items() if part in name}
    ratios, kinds, seconds = [], collections.Counter(), []
    for name, problem in problems.items():
        runs, moved = Runs(problem), Runs(problem, moved=1e-13)
        for target in (1e-1, 1e-2, 1e-3, 1e-4, 1e-5):
            begin = time.process_time()
            advice = jeuler.advise_step(problem.f, problem.y0, t0=problem.t0, t1=problem.t1, error=target)
            seconds.append(time.process_time() - begin)
            run_it = advice.feasible and advice.num_steps * problem.y0.size <= LONGEST
            ratio = runs(advice.num_steps) / target if run_it else math.nan
            print(f"{name:22s} {target:.0e}  {ratio:8.2g}  {seconds[-1]:4.1f} s  {advice.reason}", flush=True)
            if not run_it:
                kinds["unchecked" if advice.feasible else "refused"] += 1
                continue
            ratios.append(ratio)
            if ratio < 1 / 3:
                missed, evidence = larger_steps(runs, moved, advice.num_steps, target)
                kinds["missed" if missed else "stability"] += 1
                print(f"{'':44s}{evidence}", flush=True)
    ratios = np.array(ratios)
    near = np.sum((ratios >= 1 / 3) & (ratios <= 3))
    print(f"{ratios.size} answers run, {kinds['unchecked']} too long to run; at most {ratios.max():.2f} of the target")
    print(f"within a factor 3 of the target, on both sides: {near}, {near / ratios.size:.1%} of all")
    print(
        f"better than that: {kinds['stability']} where no larger dt meets the target and holds (stability sets dt), "
        f"{kinds['missed']} where one would have done"
    )
    print(f"within a factor 3 where accuracy sets dt: {near / (ratios.size - kinds['stability']):.1%}")
    print(
        f"{kinds['refused']} refused, with a reason; CPU seconds an answer: median {np.median(seconds):.1f}, "
        f"longest {max(seconds):.1f}"
    )


if __name__ == "__main__":
    given = arguments(__doc__, path=REQUIRED, part="")
    main(given.path, given.part)
