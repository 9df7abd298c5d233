"""What a pool of particles costs: python benchmarks/pool.py

Three questions, answered in one run, interleaved, medians:
  turnover  a pool of 5,000 slots through which 300,000 particles pass, against one whose 5,000 never die
  capacity  200,000 slots of which 5,000 are alive, in windows and without, against 5,000 slots
"""

import os
import platform
import statistics
import time

import jax
import numpy as np

from jeuler import Gravity, Scene, simulate, symplectic_euler_step
from jeuler.effects import Cone, Emitter, FromDisc, Lifetime, OverLife, Uniform
from jeuler.forces import LinearDrag
from jeuler.state import empty_pool

ALIVE, STEPS, DT, REPEATS = 5_000, 6_000, 0.01, 7
WINDOWS = (7_168, 16_384, 65_536)


def scene(lifetime: float, rate: float, burst: int) -> Scene:
    """A jet in the wind, its drops fading; ``burst`` of them at the start."""
    drops = {
        "position": FromDisc([0.0, 0.0, 0.0], 0.1),
        "velocity": Cone([0.0, 0.0, 1.0], Uniform(5.0, 7.0), 0.2),
        "lifetime": Uniform(0.9 * lifetime, 1.1 * lifetime),
    }
    stream = Emitter(rate, **drops, max_births=50)
    first = (Emitter(0.0, **drops, bursts=((0.0, burst),), max_births=burst, stop=DT),) if burst else ()
    forces = (Gravity([0.0, 0.0, -9.81]), LinearDrag(0.3, air=[2.0, 0.0, 0.0]))
    return Scene(forces, (*first, stream, Lifetime(), OverLife("opacity", [1.0, 0.0])))


def program(capacity: int, scene: Scene, windows: tuple[int, ...] = ()):
    """The compiled run from a pool that is already filled."""

    def end(scene, pool, key):
        solution = simulate(
            scene, pool, dt=DT, num_steps=STEPS, save_every=25, key=key, windows=windows, step=symplectic_euler_step,
            save=lambda t, state: (state.births, state.missed_births, state.alive.sum()),
        )  # fmt: skip
        return solution.y

    arguments = scene, filled_pool(capacity, scene), jax.random.key(0)
    compiled = jax.jit(end).lower(*arguments).compile()
    return lambda: jax.block_until_ready(compiled(*arguments))


def filled_pool(capacity: int, scene: Scene):
    """A pool with ALIVE living particles of random age, in the first slots."""
    random = np.random.default_rng(0)
    pool = empty_pool(capacity, 3)
    alive = np.arange(capacity) < ALIVE
    lifetime = float(scene.effects[0].lifetime.high)
    return pool.replace(
        alive=jax.numpy.asarray(alive),
        age=jax.numpy.asarray(np.where(alive, random.uniform(0, min(lifetime, 1e6), capacity), 0.0), "float32"),
        lifetime=jax.numpy.asarray(np.where(alive, lifetime, 0.0), "float32"),
    )


def main() -> None:
    turnover = scene(lifetime=1.0, rate=ALIVE, burst=0)  # 5,000 births a second for 60 s
    still = scene(lifetime=1e9, rate=0.0, burst=0)
    programs = {
        "5,000 slots, none is born or dies": program(ALIVE + 500, still),
        "5,000 alive, 300,000 used": program(ALIVE + 500, turnover),
        "200,000 slots, windows": program(200_000, turnover, WINDOWS),
        "200,000 slots, no windows": program(200_000, turnover),
    }
    seconds: dict[str, list[float]] = {name: [] for name in programs}
    counts = {name: run() for name, run in programs.items()}
    for repeat in range(REPEATS):
        for name, run in programs.items():
            if "no windows" in name and repeat:
                continue  # slow, and beside the point
            start = time.perf_counter()
            run()
            seconds[name].append(time.perf_counter() - start)

    print(
        f"{platform.machine()}, {os.cpu_count()} CPUs, jax {jax.__version__}, float32, {STEPS} steps, {REPEATS} runs\n"
    )
    print("| pool | particles used | alive at the end | missed | us a step | of 5,000 in use |")
    print("|---|---|---|---|---|---|")
    base = statistics.median(seconds["5,000 alive, 300,000 used"])
    for name, times in seconds.items():
        births, missed, alive = (int(x[-1]) for x in counts[name])
        median = statistics.median(times)
        print(f"| {name} | {ALIVE + births} | {alive} | {missed} | {1e6 * median / STEPS:.0f} | {median / base:.2f} |")
    ratio = base / statistics.median(seconds["5,000 slots, none is born or dies"])
    print(f"\n300,000 used against none born: {ratio:.2f} (bar 1.3)")


if __name__ == "__main__":
    main()
