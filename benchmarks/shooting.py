"""Single against multiple shooting on long and chaotic records: `python benchmarks/shooting.py [--plot FILE]`.

Lorenz (10, 28, 2.66) from (5, 20, 1), Lotka-Volterra (1.5, 1, 3, 1) from (5, 5, 5, 5), each 3,001 points over 30 s,
with the start known and unknown; and a double pendulum of two springs over 10 s, of which only the positions are seen.
Records by SciPy's method of eighth order at 1e-12; single shooting is `segments=1`.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import jeuler

jax.config.update("jax_enable_x64", True)
SPAN = np.linspace(0, 30, 3001)


def lorenz(t, y, p):
    return jnp.stack([p[0] * (y[1] - y[0]), y[0] * (p[1] - y[2]) - y[1], y[0] * y[1] - p[2] * y[2]])


def lotka_volterra(t, y, p):
    return jnp.stack([p[0] * y[0] - p[1] * y[0] * y[1], -p[2] * y[1] + p[3] * y[0] * y[1]])


def pendulum(t, y, p):
    """Two masses of 1 kg on springs (ks, ks, L, L) below a fixed point; y = (x1, x2, v1, v2)."""
    a, b, va, vb = y.reshape(4, 2)
    upper, lower = a, b - a
    lengths = jnp.linalg.norm(upper), jnp.linalg.norm(lower)
    pull_a, pull_b = (
        k * (1 - length / r) * d for k, length, r, d in zip(p[:2], p[2:], lengths, (upper, lower), strict=True)
    )
    weight = jnp.array([0.0, -9.81])
    return jnp.concatenate([va, vb, pull_b - pull_a + weight, weight - pull_b])


def record(f: Any, p: Any, y0: Any, times: np.ndarray) -> np.ndarray:
    slope = jax.jit(lambda t, y: f(t, y, jnp.asarray(p)))
    found = solve_ivp(lambda t, y: np.asarray(slope(t, y)), times[[0, -1]], y0, "DOP853", times, rtol=1e-12, atol=1e-12)
    return found.y.T


def row(name: str, found: jeuler.ShootingFit, true: Any, began: float) -> None:
    error = np.max(np.abs(np.asarray(found.params) / np.asarray(true) - 1))
    values = ", ".join(f"{x:.5g}" for x in np.asarray(found.params))
    print(
        f"{name}: {values}; largest error {error:.1e}, converged {found.converged}, "
        f"{time.process_time() - began:.1f} s of CPU",
        flush=True,
    )


def both(name: str, f: Any, true: Any, guess: Any, y0: Any) -> tuple[np.ndarray, Any, Any, Any]:
    x = record(f, true, y0, SPAN)
    kept = {}
    for how, segments in (("single", 1), ("multiple", None)):
        for known in (True, False):
            began = time.process_time()
            start = np.asarray(y0) if known else None
            found = jeuler.multiple_shooting(f, jnp.asarray(guess), SPAN, x, dt=0.01, y0=start, segments=segments)
            row(f"{name}, {how} shooting, start {'known' if known else 'unknown'}", found, true, began)
            kept[how] = found
    began = time.process_time()
    noisy = x + 0.01 * x.std(axis=0) * np.random.default_rng(0).normal(size=x.shape)
    found = jeuler.multiple_shooting(f, jnp.asarray(guess), SPAN, noisy, dt=0.01)
    row(f"{name} with 1 % of noise, multiple shooting, start unknown", found, true, began)
    return x, kept["single"], kept["multiple"], found


def springs() -> None:
    true, times = (80.0, 60.0, 1.0, 0.8), np.linspace(0, 10, 1001)
    y0 = (1.0, 0.1, 1.7, 0.5, 0.0, 0.0, 0.0, 0.0)
    x = record(pendulum, true, y0, times)
    near = record(pendulum, true, np.asarray(y0) + 1e-6, times)
    apart = np.linalg.norm(x - near, axis=1)
    print(f"spring pendulum: 1e-6 apart at the start, {apart[-1]:.1e} after 10 s")
    seen = x.copy()
    seen[:, :4] += 1e-3 * np.random.default_rng(0).normal(size=(1001, 4))
    seen[:, 4:] = np.nan
    guess = np.concatenate([seen[:, :4], np.gradient(seen[:, :4], times, axis=0)], axis=1)
    for how, segments in (("single", 1), ("multiple", 40)):
        began = time.process_time()
        found = jeuler.multiple_shooting(
            pendulum, jnp.asarray([40.0, 40.0, 0.9, 0.9]), times, seen, dt=0.01, guess=guess, segments=segments
        )
        row(f"spring pendulum at 1 mm of noise, {how} shooting", found, true, began)


def picture(path: str, rows: list[Any]) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(len(rows), 3, figsize=(13, 3.1 * len(rows)), layout="constrained", squeeze=False)
    for line, (name, x, single, multiple, noisy) in zip(axes, rows, strict=True):
        for axis, how, found in ((line[0], "single", single), (line[1], "multiple", multiple)):
            axis.plot(SPAN, x[:, 0], color="0.75", linewidth=3, label="record")
            axis.plot(SPAN, found.predicted[:, 0], linewidth=1, label="fit")
            axis.set(title=f"{name}: {how} shooting", xlabel="t [s]")
            axis.margins(y=0.25)
            axis.legend(loc="upper left", ncols=2, fontsize="small")
        line[2].loglog([s[0] for s in noisy.stages], [s[1] for s in noisy.stages], "o-")
        line[2].set(title="largest gap over the motion, 1 % noise", xlabel="weight of the gaps")
    figure.savefig(path, dpi=80)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--plot", help="where the figure goes")
    given = parser.parse_args()
    springs()
    rows = [
        ("Lorenz", *both("Lorenz", lorenz, (10, 28, 2.66), (5.0, 20.0, 1.0), (1.0, 1.0, 1.0))),
        (
            "Lotka-Volterra",
            *both("Lotka-Volterra", lotka_volterra, (1.5, 1, 3, 1), (5.0, 5.0, 5.0, 5.0), (1.0, 1.0)),
        ),
    ]
    if given.plot:
        picture(given.plot, rows)


if __name__ == "__main__":
    main()
