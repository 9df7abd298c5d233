"""Particles that see each other: a step by rows of neighbours, beside jax-md on the same potential.

    python benchmarks/neighbours.py [PARTICLES [STEPS]]      100,000 and 50 without a word

A periodic box of soft spheres, E = eps / 2 (1 - r / s)^2 for r < s, some 7 of them touching each, moving at random, in
float32. Both carry rows of neighbours through one scan of symplectic Euler steps, and make them again when a particle
has moved half a skin; both report how many found no place. Then the forces of 5,000 agents in the plane.
"""

import sys
import time

import jax
import numpy as np

import jeuler

S, EPS, SKIN, DT, MASS, SPEED = 1.0, 10.0, 0.3, 2e-3, 1.0, 1.0


def start(particles):
    """Positions, velocities and the side of the box."""
    random = np.random.default_rng(0)
    box = (particles / 1.7) ** (1 / 3)
    return (
        random.uniform(0, box, (particles, 3)).astype("f4"),
        SPEED * random.normal(size=(particles, 3)).astype("f4"),
        box,
    )


def ours(x, v, box, steps):
    near = jeuler.Neighbours(S, SKIN, capacity=40, box=[box] * 3)
    scene = jeuler.Scene((jeuler.SoftRepulsion(near, S, ks=EPS / S**2),), (near,))

    @jax.jit
    def run(x, v):
        step = jeuler.symplectic_euler_step
        state = jeuler.ParticleState(x, v, MASS)
        end = jeuler.simulate(scene, state, dt=DT, num_steps=steps, save_every=steps, step=step).y
        return end.position[-1], end.missed_neighbours[-1]

    return run


def theirs(x, v, box, steps):
    from jax_md import energy, partition, space

    displacement, shift = space.periodic(box)
    rows, potential = energy.soft_sphere_neighbor_list(
        displacement, box, sigma=S, epsilon=EPS, alpha=2, dr_threshold=SKIN, format=partition.Dense
    )
    first = rows.allocate(x, extra_capacity=6)
    force = jax.grad(lambda x, rows: -potential(x, neighbor=rows))

    @jax.jit
    def run(x, v):
        def step(carry, _):
            x, v, rows = carry
            v = v + DT / MASS * force(x, rows)
            x = shift(x, DT * v)
            return (x, v, rows.update(x)), None

        (x, v, rows), _ = jax.lax.scan(step, (x, v, first.update(x)), None, length=steps)
        return x, rows.did_buffer_overflow

    return run


def milliseconds(run, *args, rounds=3):
    """Of a call, the median, and what it returned."""
    out = jax.block_until_ready(run(*args))
    times = []
    for _ in range(rounds):
        begin = time.perf_counter()
        jax.block_until_ready(run(*args))
        times.append(1e3 * (time.perf_counter() - begin))
    return float(np.median(times)), out


def agents(number=5000, steps=200):
    near = jeuler.Neighbours(1.0, 0.5, capacity=32)
    scene = jeuler.Scene((jeuler.Flocking(near, 2.0, 1.0, 0.5), jeuler.SoftRepulsion(near, 0.5, 50.0)), (near,))
    random = np.random.default_rng(1)
    side = np.sqrt(number) * 0.7
    x, v = random.uniform(0, side, (number, 2)).astype("f4"), random.normal(size=(number, 2)).astype("f4")

    @jax.jit
    def run(x, v):
        state = jeuler.ParticleState(x, v)
        end = jeuler.simulate(scene, state, dt=0.01, num_steps=steps, save_every=steps).y
        return end.position[-1], end.missed_neighbours[-1]

    cost, (_, missed) = milliseconds(run, x, v)
    print(f"{number} agents, flocking and repulsion: {cost / steps:.2f} ms a step, {int(missed)} missed")


def main():
    particles, steps = (int(word) for word in [*sys.argv[1:], *("100000", "50")[len(sys.argv) - 1 :]])
    x, v, box = start(particles)
    found = {}
    for name, make in (("jeuler", ours), ("jax-md", theirs)):
        try:
            run = make(x, v, box, steps)
        except ImportError:
            print(f"{name} is not installed")
            continue
        cost, (end, missed) = milliseconds(run, x, v)
        found[name] = end
        print(f"{name}: {particles} particles, {cost / steps:.1f} ms a step over {steps} steps, missed: {missed}")
    if len(found) == 2:
        d = np.asarray(found["jeuler"]) - np.asarray(found["jax-md"])
        print(f"the two runs end {np.abs(d - box * np.round(d / box)).max():.1e} m apart")
    agents()


if __name__ == "__main__":
    main()
