"""advise_method on published initial value problems: what its first choice costs against the true best.

    python benchmarks/advise_method.py [tests/data/ode_problems.json] [--part NAME] [--targets 1e-3 1e-6]

The true best is found by brute force: every method at numbers of steps 8 % apart and at tolerances a factor 1.6 apart,
from the coarsest on, as long as a run takes less than four times the fastest that met the target; errors are against
the published end values. The first choice and the three fastest of those are then run as the line of Python that
advise_method writes for them, each compiled by itself, and timed in turns: the least of 15 rounds counts.
"""

import argparse
import math
import pathlib
import sys
import time

import diffrax  # the lines of Python name it
import jax
import numpy as np

import jeuler
from jeuler.accuracy.candidates import Problem, default_candidates
from jeuler.accuracy.trials import Trial
from jeuler.accuracy.written import code_of

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parent.parent / "tests"))
from published import PROBLEMS, problems_in

GRID, TOLERANCES = 1.08, 1.6  # from one setting to the next
FINALISTS, ROUNDS = 3, 15
LONGEST = 1.0  # s a run, while no method has met the target
TOLERATED = 1.5


def settings(candidate, size):
    """From the cheapest to the most expensive."""
    if candidate.adaptive:
        parts = (1.0, 1e-4) if candidate.program_size else (1.0,)
        rtols = 0.1 * TOLERANCES ** -np.arange(60.0)
        return [(float(rtol), float(part * size * rtol)) for rtol in rtols if rtol > 1e-13 for part in parts]
    return sorted({round(GRID**k) for k in range(1, 240)})


def brute_force(trials, reference, target, size):
    """(seconds, candidate, setting, steps) of the cheapest run of each method that meets the target."""
    best, found, scale = math.inf, [], np.linalg.norm(reference)
    for trial in sorted(trials, key=lambda trial: "solve_adaptive" not in trial.candidate.name):
        for setting in settings(trial.candidate, size):
            outcome = trial.outcome(setting, reference, scale)
            if outcome.error <= target:
                found.append((outcome.seconds, trial.candidate, setting, outcome.num_steps))
                best = min(best, outcome.seconds)
                break
            limit = LONGEST if math.isinf(best) else max(1e-3, 4 * best)
            if outcome.seconds > limit and trial.slower_than(outcome, limit):
                break
    return sorted(found, key=lambda each: each[0])


def timed(codes, names):
    """The least seconds of each line of Python, in turns."""
    runs, least = {}, dict.fromkeys(codes, math.inf)
    for code in codes:
        program = compile(code, "run", "eval")

        def last(y0, program=program):
            solution = eval(program, names | {"y0": y0})
            return (solution.ys if hasattr(solution, "ys") else solution.y)[-1]

        runs[code] = jax.jit(last)
        jax.block_until_ready(runs[code](names["y0"]))
    for _ in range(ROUNDS):
        for code, run in runs.items():
            begun = time.perf_counter()
            jax.block_until_ready(run(names["y0"]))
            least[code] = min(least[code], time.perf_counter() - begun)
    return least


def one_problem(name, problem, targets):
    """For each target, seconds of the first choice over those of the true best."""
    f, y0, t0, t1, reference = problem
    equation = Problem(f, y0, t0, t1, None, ())
    names = {"jeuler": jeuler, "diffrax": diffrax, "f": f, "y0": y0}
    trials = [Trial(candidate, equation, np.float64) for candidate in default_candidates(f, y0, t0, None)]
    for target in targets:
        advice = jeuler.advise_method(f, y0, t0=t0, t1=t1, error=target)
        choice = advice.best
        for trial in trials:
            trial.known = {}
            trial.final((0.1, 0.1) if trial.candidate.adaptive else 1)
        rms = np.sqrt(np.mean(np.square(reference)))
        found = brute_force(trials, reference, target, rms)
        codes = {code_of(c, equation, s, n, scene=False): c.name for _, c, s, n in found[:FINALISTS]}
        if choice is None:
            print(f"{name:24s} {target:.0e}  no choice ({len(codes)} methods reach it)  {advice.reason}", flush=True)
            yield math.inf if codes else 1.0
            continue
        codes = {choice.code: choice.name} | codes
        seconds = timed(codes, names)
        best = min(seconds, key=seconds.get)
        ratio = seconds[choice.code] / seconds[best]
        solution = eval(choice.code, names)
        last = (solution.ys if hasattr(solution, "ys") else solution.y)[-1]
        error = np.linalg.norm(np.asarray(last) - reference) / np.linalg.norm(reference) / target
        print(
            f"{name:24s} {target:.0e}  {ratio:5.2f}  {choice.name} {seconds[choice.code]:.2e} s (said "
            f"{choice.seconds:.2e}), true best {codes[best]} {seconds[best]:.2e} s; error {error:.2f} of the target; "
            f"advice took {advice.trial_seconds:.0f} s",
            flush=True,
        )
        yield ratio


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("path", nargs="?", default=PROBLEMS)
    parser.add_argument("--part", default="", help="only problems with this in their name; several by commas")
    parser.add_argument("--targets", type=float, nargs="+", default=[1e-3, 1e-6])
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    ratios = []
    for name, problem in problems_in(given.path).items():
        if any(part in name for part in given.part.split(",")):
            ratios += list(one_problem(name, problem, given.targets))
    ratios = np.array(ratios)
    near = np.sum(ratios <= TOLERATED)
    print(
        f"first choice within {TOLERATED} times the true best in {near} of {ratios.size} cases, "
        f"{near / ratios.size:.0%}; median {np.median(ratios):.2f}, worst {ratios.max():.2f}"
    )


if __name__ == "__main__":
    main()
