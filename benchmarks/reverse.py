"""Forward run and reverse-mode gradient of explicit steps on small systems: ``python benchmarks/reverse.py``.

Lorenz's equations and a chain of ten springs, 5,000 steps, float32, medians of 7 interleaved rounds.
"""

import statistics
import time

import jax
import jax.numpy as jnp
import numpy as np

import jeuler

STEPS, ROUNDS, SPRINGS = 5_000, 7, 10


def lorenz(step):
    def field(t, y, p):
        return jnp.stack([p[0] * (y[1] - y[0]), y[0] * (p[1] - y[2]) - y[1], y[0] * y[1] - p[2] * y[2]])

    def final(y0, p):
        run = jeuler.solve(field, y0, args=p, dt=5e-4, num_steps=STEPS, save_every=STEPS, step=step)
        return jnp.sum(run.y[-1])

    return final, (jnp.ones(3), jnp.array([10.0, 28.0, 8 / 3]))


def chain(step):
    line = np.stack([np.arange(SPRINGS + 1.0), np.zeros(SPRINGS + 1)], axis=1).astype(np.float32)
    state = jeuler.ParticleState(line, 0 * line, mass=np.array([np.inf] + SPRINGS * [1.0], np.float32))
    edges = [(i, i + 1) for i in range(SPRINGS)]

    def final(ks):
        scene = jeuler.Scene((jeuler.Springs(edges, ks, 0.1, 0.9), jeuler.Gravity([0.0, -9.8])))
        run = jeuler.simulate(scene, state, dt=1e-3, num_steps=STEPS, save_every=STEPS, step=step)
        return jnp.sum(run.y.position[-1])

    return final, (jnp.full(SPRINGS, 50.0),)


def seconds(function, arguments):
    begun = time.perf_counter()
    jax.block_until_ready(function(*arguments))
    return time.perf_counter() - begun


def main():
    print("| | forward, ms | reverse, ms | ratio |\n|---|--:|--:|--:|")
    for name, problem in (("Lorenz", lorenz), ("chain", chain)):
        for step in (jeuler.euler_step, jeuler.heun_step, jeuler.rk4_step):
            final, arguments = problem(step)
            programs = jax.jit(final), jax.jit(jax.value_and_grad(final, argnums=tuple(range(len(arguments)))))
            for program in programs:
                seconds(program, arguments)
            rounds = [[seconds(program, arguments) for program in programs] for _ in range(ROUNDS)]
            forward, reverse = (1e3 * statistics.median(column) for column in zip(*rounds, strict=True))
            print(f"| {name}, {step.__name__} | {forward:.3g} | {reverse:.3g} | {reverse / forward:.3g} |", flush=True)


if __name__ == "__main__":
    main()
