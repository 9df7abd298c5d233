"""How many random crushed nets one implicit step solves, with and without damped iterations, and what they cost.

python benchmarks/crushed_nets.py
"""

import pathlib
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
from arguments import arguments

import jeuler

ROOT = pathlib.Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "tests"))
from hard_scenes import cloth, cloth_scene  # noqa: E402

NETS, KS, KD = 50, 1e4, 100.0  # the explicit limit is kd / ks = 0.01 s
STEPS = {"Newton": jeuler.implicit_euler(damped_steps=0), "Newton, then damped": jeuler.implicit_euler()}
ENERGY_OF = jax.vmap(lambda scene, x, v: scene.energy(0.0, (x, v), 1.0), in_axes=(None, 0, 0))


def crushed(particles, dim):
    """One step of nets in which every pair has a spring of 1 m and all begin within a part of that."""
    scene = jeuler.Scene((jeuler.Springs([(i, j) for i in range(particles) for j in range(i)], KS, KD, 1.0),))
    random = np.random.default_rng(0)
    for name, step in STEPS.items():

        @jax.jit
        @jax.vmap
        def advance(x, v, dt, step=step):
            return step.with_info(scene.vector_field, 0.0, (x, v), dt, 1.0)

        for extent in (0.02, 0.2):
            for factor in (5, 50, 500):
                for speed in (0.0, 3.0):
                    x, v = random.normal(size=(2, NETS, particles, dim))
                    x, v = extent * x, speed * v
                    (x1, v1), info = advance(x, v, jnp.full(NETS, factor * KD / KS))
                    gain = ENERGY_OF(scene, x1, v1) / ENERGY_OF(scene, x, v) - 1
                    yield name, extent, factor, speed, info, np.nanmax(gain, initial=-1)


def seconds(run, *args, repeats=7):
    jax.block_until_ready(run(*args))
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(run(*args))
        times.append(time.perf_counter() - start)
    return min(times)


def costs():
    """Microseconds a step of runs that Newton's method solves."""
    spring = jeuler.Scene((jeuler.Springs([(0, 1)], 100.0, 1.0, 1.0),))
    two = jeuler.ParticleState([[0.0], [1.2]], [[0.0], [0.0]], mass=[jnp.inf, 1.0])
    for name, scene, state, num_steps in (
        ("one spring", spring, two, 2000),
        ("cloth 16 x 16", cloth_scene(16, 2000.0, 0.01), cloth(16), 20),
    ):
        for method, step in STEPS.items():
            for kind in ("run", "gradient"):

                def end(ks, scene=scene, state=state, num_steps=num_steps, step=step):
                    stiffer = jax.tree.map(lambda leaf: ks * leaf, scene)
                    run = jeuler.simulate(stiffer, state, dt=1e-3, num_steps=num_steps, save_every=num_steps, step=step)
                    return jnp.sum(run.y.position**2)

                best = seconds(jax.jit(end if kind == "run" else jax.grad(end)), 1.0)
                yield f"{name}, {kind}, {method}: {1e6 * best / num_steps:.1f} us a step"


def main():
    arguments(__doc__)
    jax.config.update("jax_enable_x64", True)
    for particles, dim in ((5, 2), (12, 3)):
        total = dict.fromkeys(STEPS, 0.0)
        for name, extent, factor, speed, info, gain in crushed(particles, dim):
            solved = float(jnp.mean(info.converged))
            total[name] += solved / 12
            print(
                f"{particles} in {dim}-D, extent {extent}, {factor} x limit, {speed} m/s, {name}: {solved:.0%} solved, "
                f"{jnp.median(info.iterations):.0f} iterations, largest gain of energy {gain:+.0%}",
                flush=True,
            )
        print({name: f"{solved:.1%} of {12 * NETS}" for name, solved in total.items()}, flush=True)
    for line in costs():
        print(line, flush=True)


if __name__ == "__main__":
    main()
