"""advise_step over its steps, problems, spring scenes and switched fields: achieved error against target.

    python benchmarks/step_advice.py [all | problems | scenes | switched] [--log FILE] [--part NAME] [--steps euler rk4]
        [--targets 1e-2] [--patience SECONDS]

Each answer is printed as it comes. With --log FILE it is kept there too, as one line of JSON, and a run that was cut
off goes on after the last of them.

Errors are relative, |y - reference| / |reference| at t1, in float64. References: published end values; for scenes, runs
of `solve_adaptive` at rtol 1e-12; for fields that switch or kink, exact solutions written out piece by piece. Every
answer is run that advances at most 3e9 numbers (3e7 where a step solves equations). Reasons are checked by runs:

- "confirmed", "predicted": the error is between a third of the target and 1.1 of it;
- "stability sets dt": none of 60 larger dts, up to twice as large, meets the target and comes within a factor 3 of it
  with dt 1 % larger;
- "with one step fewer": that run misses the target;
- linearly implicit steps named: their run meets the target;
- "no larger dt": as for stability; the answer then counts as the least number of steps, not as too many;
- refused for stability: a run of half the steps that it asks for is lost or misses the target.
"""

import argparse
import collections
import json
import math
import pathlib
import re
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np

import jeuler
from jeuler.accuracy.pilot import Pilot, distance

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parent.parent / "tests"))
from advice_problems import FIELDS, more_problems, spring_scenes
from published import Published, problems_in

STEPS = {
    "euler": jeuler.euler_step,
    "heun": jeuler.heun_step,
    "rk4": jeuler.rk4_step,
    "extrapolated": jeuler.extrapolated_euler(4),
    "implicit": jeuler.implicit_euler_step,
    "linearly implicit": jeuler.linearly_implicit_euler_step,
    "midpoint": jeuler.implicit_midpoint_step,
    "symplectic": jeuler.symplectic_euler_step,
}
LONGEST, LONGEST_IMPLICIT = 3e9, 3e7  # numbers advanced
ABOVE, FACTOR = 1.1, 3.0
PARTS = "scenes", "switched", "problems"
KEY = "part", "problem", "step", "target"


class Runs:
    """Errors of runs of one problem by one step, in terms of a target, each made once."""

    def __init__(self, problem, args, step):
        self.run = Pilot(problem.f, problem.y0, problem.t0, problem.t1, args, step, float, False)
        self.reference, self.known = problem.reference, {}

    def __call__(self, num_steps):
        if num_steps not in self.known:
            error = distance(self.run(num_steps)[-1], self.reference) / np.linalg.norm(self.reference)
            self.known[num_steps] = error if math.isfinite(error) else math.inf
        return self.known[num_steps]


def larger_would_do(runs, num_steps, target):
    """Whether a larger dt meets the target, and with dt 1 % larger still comes within a factor 3."""
    counts = sorted({int(n) for n in np.round(num_steps * np.geomspace(0.98, 0.5, 60)) if n < num_steps})
    return any(runs(n) <= target and runs(math.ceil(0.99 * n)) <= FACTOR * target for n in counts if n)


def false_reason(advice, runs, linear, target):
    """What is false in the reason of an answer that was run, or ''."""
    reason, ratio = advice.reason, runs(advice.num_steps) / target
    named = re.search(r"linearly_implicit_euler_step meets the target with ([\d,]+)", reason)
    if named and linear(int(named[1].replace(",", ""))) > ABOVE * target:
        return "the linearly implicit steps that it names miss the target"
    if ("confirmed" in reason or "predicted" in reason) and not 1 / FACTOR <= ratio <= ABOVE:
        return "neither confirmed nor predicted"
    if "with one step fewer" in reason and runs(advice.num_steps - 1) <= 0.8 * target:
        return "one step fewer would do"
    largest = "stability, not" in reason or "no larger dt" in reason
    if largest and larger_would_do(runs, advice.num_steps, 0.8 * target):
        return "a larger dt would do"
    return ""


def false_refusal(advice, runs, target, longest):
    """What is false in a refusal, or ''."""
    needs = re.search(r"asks? for dt <= ([\d.e+-]+) s, ([\d.e+]+) steps", advice.reason)
    if needs and float(needs[2]) / 2 < longest and runs(int(float(needs[2]) / 2)) <= target / FACTOR:
        return "half the steps that it asks for would do"
    return ""


def check(part, title, problem, args, step_name, target, patience):
    """One answer, as a dictionary."""
    step = STEPS[step_name]
    runs = Runs(problem, args, step)
    linear = Runs(problem, args, jeuler.linearly_implicit_euler_step)
    begun = time.process_time()
    asked = {"t0": problem.t0, "t1": problem.t1, "args": args, "error": target}
    advice = jeuler.advise_step(problem.f, problem.y0, **asked, step=step, patience=patience)
    seconds = time.process_time() - begun
    explicit = hasattr(getattr(step, "base", step), "increment")
    longest = (LONGEST if explicit else LONGEST_IMPLICIT) / np.size(problem.reference)
    ratio, wrong = math.nan, ""
    if not advice.feasible:
        kind, wrong = "refused", false_refusal(advice, runs, target, longest)
    elif advice.num_steps > longest:
        kind = "not run"
    else:
        ratio, wrong = runs(advice.num_steps) / target, false_reason(advice, runs, linear, target)
        kind = kind_of(ratio, advice.reason, wrong)
    key = dict(zip(KEY, (part, title, step_name, target), strict=True))
    return key | {"kind": kind, "ratio": ratio, "seconds": seconds, "wrong": wrong, "reason": advice.reason}


def kind_of(ratio, reason, wrong):
    """Where an answer that was run stands."""
    if ratio > ABOVE:
        return "above"
    if ratio >= 1 / FACTOR:
        return "near"
    if wrong:
        return "far"
    if "stability, not" in reason or "one step" in reason:
        return "bound"
    return "least" if "no larger dt" in reason else "far"


def show(answer):
    print(
        f"{answer['problem']:22s} {answer['step']:17s} {answer['target']:.0e} {answer['ratio']:6.2f} "
        f"{answer['kind']:8s}{answer['seconds']:5.1f} s  {answer['reason']}",
        flush=True,
    )
    if answer["wrong"]:
        print(f"{'':40s}FALSE: {answer['wrong']}", flush=True)


def report(title, answers):
    """One paragraph of counts."""
    count = collections.Counter(answer["kind"] for answer in answers)
    run = [answer["ratio"] for answer in answers if answer["kind"] in ("above", "near", "bound", "least", "far")]
    seconds = [answer["seconds"] for answer in answers]
    free = count["near"] + count["far"] + count["above"]
    print(
        f"{title}: {len(run)} answers run, {count['not run']} too long to run, {count['refused']} refused; the largest "
        f"error is {max(run, default=math.nan):.2f} of its target, {count['above']} above {ABOVE}; stability or one "
        f"step more decides {count['bound']}, no larger dt does in {count['least']} more; of the others "
        f"{count['near']} of {free} are within a factor {FACTOR:g}, {count['near'] / max(1, free):.1%} (with those "
        f"{count['least']} {count['near'] / max(1, free + count['least']):.1%}); "
        f"{sum(bool(answer['wrong']) for answer in answers)} false reasons; CPU seconds an answer: median "
        f"{np.median(seconds):.1f}, longest {max(seconds):.1f}"
    )


def cases_of(part):
    """{name: (problem, args)}, and the names of its steps."""
    if part == "scenes":
        cases = {name: (Published(f, y0, 0.0, t1, end), args) for name, (f, y0, t1, args, end) in spring_scenes()}
        return cases, ["symplectic", "rk4"]
    if part == "switched":
        cases = {
            name: (Published(f, jnp.asarray(y0, float), 0.0, t1, np.atleast_1d(end)), None)
            for name, (f, y0, t1, end) in FIELDS.items()
        }
        return cases, ["euler", "heun", "rk4", "extrapolated"]
    cases = {name: (problem, None) for name, problem in {**problems_in(), **more_problems()}.items()}
    return cases, [name for name in STEPS if name != "symplectic"]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", nargs="?", choices=("all", *PARTS), default="all")
    parser.add_argument("--log", type=pathlib.Path, default=None, help="file of answers, gone on with if it is there")
    parser.add_argument("--part", default="", help="only those with this in their name; several by commas")
    parser.add_argument("--steps", nargs="+", choices=list(STEPS), default=None)
    parser.add_argument("--targets", type=float, nargs="+", default=[1e-2, 1e-4])
    parser.add_argument("--patience", type=float, default=120.0, help="seconds, of each answer")
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    log, known = given.log, {}
    if log is not None and log.exists():
        known = {tuple(a[k] for k in KEY): a for a in map(json.loads, log.read_text().splitlines())}
    answers = []
    for part in PARTS if given.what == "all" else [given.what]:
        cases, steps = cases_of(part)
        for name, (problem, args) in cases.items():
            if not any(each in name for each in given.part.split(",")):
                continue
            for step_name in given.steps or steps:
                for target in given.targets:
                    answer = known.get((part, name, step_name, target))
                    if answer is None:
                        answer = check(part, name, problem, args, step_name, target, given.patience)
                        if log is not None:
                            with log.open("a") as file:
                                print(json.dumps(answer), file=file)
                    show(answer)
                    answers.append(answer)
    for part in PARTS:
        if chosen := [answer for answer in answers if answer["part"] == part]:
            report(part, chosen)
    if answers:
        report("all", answers)


if __name__ == "__main__":
    main()
