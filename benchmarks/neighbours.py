"""Particles that see each other: a step by rows of neighbours, beside jax-md and Warp on the same potential.

    python benchmarks/neighbours.py [PARTICLES [STEPS]]      100,000 and 50 without a word

A periodic box of soft spheres, E = eps / 2 (1 - r / s)^2 for r < s, some 7 of them touching each, moving at random, in
float32. jeuler and jax-md carry rows of neighbours through one scan of symplectic Euler steps, and make them again when
a particle has moved half a skin; both report how many found no place. Warp has no rows: it sorts the particles into the
cells of its hash grid at each step. Then the forces of 5,000 agents in the plane.
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


def jax_md(x, v, box, steps):
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


def warp(x, v, box, steps):
    import warp as wp
    import warp_kernels as kernels

    wp.config.quiet = True
    wp.init()
    cells = int(box / S)  # the grid repeats after that many, as the box does
    grid = wp.HashGrid(cells, cells, cells, device="cpu")

    def run(x, v):
        here = [wp.array(one, dtype=wp.vec3, device="cpu") for one in (x, v)]
        there = [wp.empty_like(one) for one in here]
        for _ in range(steps):
            grid.build(points=here[0], radius=box / cells)
            numbers = [S, EPS / S**2, box, DT / MASS, DT]
            wp.launch(kernels.soft_repulsion_step, len(x), [grid.id, *here, *there, *numbers], device="cpu")
            here, there = there, here
        return here[0].numpy(), "none, as it has no rows"

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
    near = jeuler.Neighbours(1.0, 0.4, capacity=28)
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
    for name, make in (("jeuler", ours), ("jax-md", jax_md), ("Warp", warp)):
        try:
            run = make(x, v, box, steps)
        except ImportError:
            print(f"{name} is not installed")
            continue
        cost, (end, missed) = milliseconds(run, x, v)
        found[name] = end
        print(f"{name}: {particles} particles, {cost / steps:.1f} ms a step over {steps} steps, missed: {missed}")
    for name in found.keys() - {"jeuler"}:
        d = np.asarray(found["jeuler"]) - np.asarray(found[name])
        print(f"{name} ends at most {np.abs(d - box * np.round(d / box)).max():.1e} m from jeuler")
    agents()


if __name__ == "__main__":
    main()
