"""A net of 20 springs by exact derivatives and by CMA-ES: loss against seconds of CPU, from the same wrong start.

    pip install cmaes
    python benchmarks/fits_cmaes.py [seconds] [PICTURE]      60 s of CMA-ES, docs/cmaes.png

Stiffness and damping of each spring over a decade, 40 unknowns, 51 samples in 1 s, 0.1 % noise, data by diffrax's Tsit5
at 1e-9. Both run RK4 at dt = 0.01, float64, and start at ks = 100, kd = 1. CMA-ES has a population of its default size,
run as one batch of a compiled program, and searches logarithms. Seconds are of CPU, of all threads, and count all
compilation: what else the machine does changes them little.
"""

import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
from fits import made
from scipy.spatial import Delaunay

import jeuler
from jeuler.fitting.minimise import Watch

jax.config.update("jax_enable_x64", True)
TIMES = np.linspace(0, 1, 51)


def problem(seed=4):
    """A thrown net of 20 springs, what was measured of it, and the truth."""
    random = np.random.default_rng(seed)
    x = random.uniform(0, 1.2, size=(8, 3))
    pairs = {tuple(sorted((int(a), int(b)))) for s in Delaunay(x).simplices for a in s for b in s if a != b}
    edges = np.array(sorted(pairs, key=lambda pair: float(np.linalg.norm(x[pair[0]] - x[pair[1]])))[:20])
    length = np.linalg.norm(x[edges[:, 0]] - x[edges[:, 1]], axis=1)
    ks, kd = 50 * 10 ** random.uniform(size=20), 0.3 * 10 ** random.uniform(size=20)
    v = random.normal(size=x.shape)
    clean = made(jeuler.Scene((jeuler.Springs(edges, ks, kd, length),)), x, v, np.ones(8), TIMES)
    y = clean + 1e-3 * np.std(clean - clean.mean(axis=0)) * random.normal(size=clean.shape)
    scene = jeuler.Scene((jeuler.Springs(edges, np.full(20, 100.0), np.ones(20), length),))
    return scene, jeuler.ParticleState(x, v, np.ones(8)), y, ks, kd


def by_jeuler(scene, state, y, start):
    """Seconds and loss after each iteration, and the fit."""
    jax.clear_caches()
    path, see, begun = [], Watch.see, time.process_time()

    def noted(watch, stage, search, history, counted):
        see(watch, stage, search, history, counted)
        path.append((time.process_time() - begun, float(search.total) / y.size))

    Watch.see = noted
    found = jeuler.fit_springs(scene, state, TIMES, y, dt=0.01, start=start, progress=False)
    Watch.see = see
    path.append((time.process_time() - begun, float(found.loss)))
    return np.array(path), found


def by_cmaes(scene, state, y, seconds):
    """Seconds and the least loss so far after each generation, and the best parameters."""
    import cmaes

    springs, begun = scene.forces[0], time.process_time()

    def loss(z):
        now = jeuler.Springs(springs.edges, jnp.exp(z[:20]), jnp.exp(z[20:]), springs.rest_length)
        run = jeuler.simulate(
            jeuler.Scene((now,)), state, dt=0.01, num_steps=100, step=jeuler.rk4_step, save_every=2,
            save=lambda t, now: now.position,
        )  # fmt: skip
        return jnp.mean((run.y - y) ** 2)

    losses = jax.jit(jax.vmap(loss))
    mean = np.log(np.concatenate([np.full(20, 100.0), np.ones(20)]))
    search = cmaes.CMA(mean=mean, sigma=1.0, seed=0)
    path, best, least = [], mean, np.inf
    while time.process_time() - begun < seconds and not search.should_stop():
        asked = [search.ask() for _ in range(search.population_size)]
        values = np.nan_to_num(np.asarray(losses(np.stack(asked))), nan=1e6, posinf=1e6)
        search.tell(list(zip(asked, values.tolist(), strict=True)))
        k = int(np.argmin(values))
        if values[k] < least:
            best, least = asked[k], float(values[k])
        path.append((time.process_time() - begun, least))
    return np.array(path), np.exp(best)


def main(seconds=60.0, picture="docs/cmaes.png"):
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    scene, state, y, ks, kd = problem()
    figure, ax = plt.subplots(figsize=(7, 4.2), layout="constrained")

    def shown(name, path, found_ks, found_kd):
        errors = [float(np.median(np.abs(np.asarray(a) / b - 1))) for a, b in ((found_ks, ks), (found_kd, kd))]
        print(
            f"{name}: {path[-1, 0]:.1f} s of CPU, loss {path[-1, 1]:.3g} m^2; "
            f"median errors ks {errors[0]:.2%}, kd {errors[1]:.2%}",
            flush=True,
        )
        ax.step(path[:, 0], path[:, 1], where="post", label=name)
        ax.plot(*path[-1], "o", color=ax.lines[-1].get_color())

    for name, start in (
        ("exact derivatives, no start (weak form)", "data"),
        ("exact derivatives, the wrong start", "given"),
    ):
        path, found = by_jeuler(scene, state, y, start)
        shown(name, path, found.ks, found.kd)
    path, best = by_cmaes(scene, state, y, seconds)
    shown(f"CMA-ES, {len(path)} generations", path, best[:20], best[20:])
    ax.set(xscale="log", yscale="log", title="20 springs, 40 unknowns, 0.1 % noise")
    ax.set_xlabel("seconds of CPU, all compilation counted")
    ax.set_ylabel("mean square residual, m$^2$")
    ax.grid(which="both", alpha=0.2)
    ax.legend()
    figure.savefig(picture, dpi=130)


if __name__ == "__main__":
    main(*([float(sys.argv[1])] if sys.argv[1:] else []), *sys.argv[2:3])
