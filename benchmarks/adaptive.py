"""solve_adaptive where f jumps, beside diffrax's Tsit5 at the same tolerances; and what it costs where f is smooth.

    python benchmarks/adaptive.py

57 switch times, a square wave on an oscillator, a ball on a floor that pushes like a spring: errors in units of rtol,
against exact solutions. Pulses of 0.1 and 0.03 s at 57 times: how many runs are wrong by more than 100 rtol, and how
many of these do not say so, by a longest_gap below the pulse. Smooth problems: evaluations of f on the published ones,
beside `extrapolated_euler(6)`, which was the default before, and Tsit5 with its own steps.
"""

import pathlib
import sys

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import jeuler

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parent.parent / "tests"))
from advice_problems import FIELDS, on_the_floor
from published import problems_in

RATE, TOLERANCES = 0.7, (1e-4, 1e-6, 1e-8)
TIMES = np.linspace(0.3, 1.7, 57)
MOST = 20_000
EVALUATIONS = 7, 25, 6  # a trial step: Tsitouras with a look between its stages, extrapolation of order 6, Tsit5


def theirs(f, y0, t1, args, rtol, t0=0.0, size=1e-3):
    return diffrax.diffeqsolve(
        diffrax.ODETerm(f), diffrax.Tsit5(), t0, t1, None, y0, args, max_steps=MOST, throw=False,
        stepsize_controller=diffrax.PIDController(rtol=rtol, atol=size * rtol),
    )  # fmt: skip


def switched(t, y, time):
    return -jnp.where(t <= time, RATE, 0.0) * y


def square_wave(t, y, args):
    return jnp.stack([y[1], jnp.where(jnp.floor(t) % 2 == 0, 1.0, -1.0) - 4.0 * y[0]])


def after_square_wave(seconds):
    """Exact, a second at a time: x - u / 4 turns with omega = 2."""
    x, v = 0.0, 0.0
    for second in range(seconds):
        middle = (1.0 if second % 2 == 0 else -1.0) / 4
        x, v = middle + (x - middle) * np.cos(2) + v / 2 * np.sin(2), -2 * (x - middle) * np.sin(2) + v * np.cos(2)
    return np.array([x, v])


def jumps(rtol):
    """(name, our error, theirs), relative, over rtol."""

    def both(f, y0, t1, args):
        ours = jeuler.solve_adaptive(f, y0, t1=t1, args=args, rtol=rtol, atol=1e-3 * rtol)
        return ours.y[-1], theirs(f, y0, t1, args, rtol).ys[-1]

    ends = jax.jit(jax.vmap(lambda time: both(switched, jnp.asarray(1.0), 2.0, time)))(TIMES)
    yield "57 switch times, the worst", *(np.max(np.abs(end / np.exp(-RATE * TIMES) - 1)) / rtol for end in ends)
    floor = FIELDS["floor"]
    cases = (
        ("square wave", square_wave, [0.0, 0.0], 10.0, after_square_wave(10)),
        ("floor", *floor[:3], on_the_floor(3)),
    )
    for name, f, y0, t1, exact in cases:
        ends = both(f, jnp.asarray(y0), t1, None)
        yield name, *(np.linalg.norm(end - exact) / np.linalg.norm(exact) / rtol for end in ends)


def pulses(rtol, length):
    """Runs that are wrong by more than 100 rtol: ours, those of them that do not say so, ours with max_dt, theirs."""

    def field(t, y, time):
        return -jnp.where((t > time) & (t <= time + length), 0.0, RATE) * y

    def run(time):
        ours = jeuler.solve_adaptive(field, jnp.asarray(1.0), t1=2.0, args=time, rtol=rtol, atol=1e-3 * rtol)
        bound = jeuler.solve_adaptive(
            field, jnp.asarray(1.0), t1=2.0, args=time, rtol=rtol, atol=1e-3 * rtol, max_dt=3 * length
        )
        return ours.y[-1], ours.longest_gap, bound.y[-1], theirs(field, jnp.asarray(1.0), 2.0, time, rtol).ys[-1]

    ours, gap, bound, other = jax.jit(jax.vmap(run))(TIMES)
    wrong = lambda y: np.abs(np.asarray(y) / np.exp(-RATE * (2.0 - length)) - 1) > 100 * rtol  # noqa: E731
    return wrong(ours).sum(), (wrong(ours) & (np.asarray(gap) < length)).sum(), wrong(bound).sum(), wrong(other).sum()


def smooth(problem):
    """Trial steps of the three at each tolerance; NaN for a run that did not finish."""
    f, y0, t0, t1, _ = problem
    size = float(np.linalg.norm(y0))

    @jax.jit
    def steps(rtol):
        counts = []
        for step in (None, jeuler.extrapolated_euler(6)):
            run = jeuler.solve_adaptive(f, y0, t0=t0, t1=t1, rtol=rtol, atol=rtol * size, step=step, max_steps=MOST)
            counts.append(jnp.where(run.finished, run.num_steps + run.num_rejected, jnp.nan))
        run = theirs(f, y0, t1, None, rtol, t0, size)
        return jnp.stack(
            [*counts, jnp.where(run.result == diffrax.RESULTS.successful, run.stats["num_steps"], jnp.nan)]
        )

    return np.array([steps(rtol) for rtol in TOLERANCES])


def main():
    jax.config.update("jax_enable_x64", True)
    for rtol in TOLERANCES:
        for name, ours, other in jumps(rtol):
            print(f"rtol {rtol:.0e}  {name}: {ours:.2g} rtol, Tsit5 of diffrax {other:.2g} rtol", flush=True)
        for length in (0.1, 0.03):
            ours, silent, bound, other = pulses(rtol, length)
            print(
                f"rtol {rtol:.0e}  pulses of {length} s: {ours} of 57 wrong, {silent} of them without a word, with "
                f"max_dt={3 * length:.2g} {bound}; Tsit5 of diffrax {other}", flush=True,
            )  # fmt: skip
    counts = np.stack([smooth(problem) for problem in problems_in().values()]) * np.array(EVALUATIONS)
    counts = counts[np.all(np.isfinite(counts), axis=(1, 2))]
    total = counts.sum(axis=(0, 1))
    each = counts.sum(axis=1)
    print(
        f"smooth: {len(counts)} problems that all finish, three tolerances: {total[0]:.0f} evaluations of f, of "
        f"extrapolation {total[1]:.0f} (ratio {total[0] / total[1]:.2f}, the worst problem "
        f"{np.max(each[:, 0] / each[:, 1]):.2f}), of Tsit5 {total[2]:.0f} ({total[0] / total[2]:.2f})"
    )


if __name__ == "__main__":
    main()
