"""advise_step on published initial value problems: achieved error against target, for each (problem, target).

    python benchmarks/step_advice.py ../shared/reference/ode_problems.json [part of a name]

The error is relative, |y - reference| / |reference| at t1, for `euler_step` in float64. Runs of more than 30 million
steps are not made; they are listed as unchecked.
"""

import json
import math
import sys

import jax
import jax.numpy as jnp
import numpy as np

import jeuler
from jeuler.accuracy import advise_step
from jeuler.accuracy.pilot import Pilot

NAMES = {name: getattr(jnp, name) for name in ("sin", "cos", "exp", "sqrt", "pi", "where", "floor", "sign")}
NAMES |= {"range": range, "sum": sum, "abs": abs}
LONGEST = 30_000_000


def main(path, part=""):
    jax.config.update("jax_enable_x64", True)
    with open(path) as file:
        problems = [p for p in json.load(file)["problems"] if part in p["name"]]
    ratios, refused, unchecked = [], 0, 0
    for problem in problems:
        right_side = eval("lambda t, y: " + problem["rhs"], NAMES)
        f = lambda t, y, args, rhs=right_side: jnp.stack([jnp.asarray(v, y.dtype) for v in rhs(t, y)])  # noqa: E731
        y0, t0, t1 = jnp.array(problem["y0"], float), problem["t0"], problem["t1"]
        reference = np.array(problem["reference"])
        run = Pilot(f, y0, t0, t1, None, jeuler.euler_step, np.float64, False)
        for target in (1e-1, 1e-2, 1e-3, 1e-4, 1e-5):
            advice = advise_step(f, y0, t0=t0, t1=t1, error=target)
            ratio = math.nan
            if not advice.feasible:
                refused += 1
            elif advice.num_steps > LONGEST:
                unchecked += 1
            else:
                error = np.linalg.norm(run(advice.num_steps)[-1] - reference) / np.linalg.norm(reference)
                ratio = error / target
                ratios.append(ratio)
            print(f"{problem['name']:22s} {target:.0e}  achieved/target {ratio:8.2g}  {advice.reason}", flush=True)
    ratios = np.array(ratios)
    near, above = np.mean((ratios >= 1 / 3) & (ratios <= 3)), np.mean(ratios <= 3)
    print(
        f"{ratios.size} checked: {near:.0%} within a factor 3, {above:.0%} at most 3 times the target, "
        f"worst {ratios.max():.2g}"
    )
    print(f"{refused} refused, {unchecked} too long to check")


if __name__ == "__main__":
    main(*sys.argv[1:])
