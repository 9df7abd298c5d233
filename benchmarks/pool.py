"""What a pool of particles costs: python benchmarks/pool.py

The same jet in the wind, drops that age and fade, in one run, interleaved, medians:
  plain      5,000 particles that always live: gravity, drag, ageing and fading; no pool, no random number
  still      a pool of 5,000, all alive, where nothing is born or dies: what a pool costs by itself
  turnover   a pool through which 300,000 particles pass, 5,000 alive at once: of 5,000 slots, where some births find
             none free, and of 5,500, where all do
  capacity   200,000 slots of which 5,000 are alive: windows that the library chooses, chosen by hand, and none
"""

import os
import platform
import statistics
import time

import jax
import jax.numpy as jnp
import numpy as np
from arguments import arguments

from jeuler import (
    Cone,
    Emitter,
    FromDisc,
    Gravity,
    Lifetime,
    LinearDrag,
    OverLife,
    ParticleState,
    Scene,
    Uniform,
    simulate,
    symplectic_euler_step,
    uses,
)
from jeuler.particles.state import empty_pool

ALIVE, STEPS, DT, REPEATS = 5_000, 6_000, 0.01, 5
FORCES = (Gravity([0.0, 0.0, -9.81]), LinearDrag(0.3, air=[2.0, 0.0, 0.0]))
DROPS = Emitter(  # 5,000 births a second for 60 s, each lives for about a second
    rate=ALIVE,
    position=FromDisc([0.0, 0.0, 0.0], 0.1),
    velocity=Cone([0.0, 0.0, 1.0], Uniform(5.0, 7.0), 0.2),
    lifetime=Uniform(0.9, 1.1),
    max_births=50,
)


@uses(sets=("age",))
def ageing(t, dt, state, key):
    return state.replace(age=state.age + dt)


def plain():
    """The same physics and fading with particles that always live."""
    random = np.random.default_rng(0)
    state = ParticleState(np.zeros((ALIVE, 3), "f"), np.tile(np.float32([0, 0, 6]), (ALIVE, 1)))
    state = state.replace(age=random.uniform(0, 1, ALIVE).astype("f"), lifetime=np.ones(ALIVE, "f"))
    return Scene(FORCES, (ageing, OverLife("opacity", [1.0, 0.0]))), state


def pool(capacity: int, births: bool = True):
    """A pool whose first ALIVE slots are taken, by drops of random age; without births nothing dies either."""
    random = np.random.default_rng(0)
    alive, life = np.arange(capacity) < ALIVE, 1.0 if births else 1e9
    state = empty_pool(capacity, 3).replace(
        alive=jnp.asarray(alive),
        age=jnp.asarray(np.where(alive, random.uniform(0, 1, capacity), 0.0), "float32"),
        lifetime=jnp.asarray(np.where(alive, life, 0.0), "float32"),
    )
    return Scene(FORCES, (*([DROPS] if births else []), Lifetime(), OverLife("opacity", [1.0, 0.0]))), state


def program(scene, state, *, save_every=25, windows=()):
    """The compiled run."""

    def end(scene, state, key):
        def counts(t, state):
            zero = jnp.int32(0)
            births = zero if state.births is None else state.births
            missed = zero if state.missed_births is None else state.missed_births
            alive = zero + len(state.position) if state.alive is None else state.alive.sum()
            # something of the motion, or the compiler would leave it out; no sum over 200,000 slots, which takes 1 ms
            seen = state.position[:64].sum() + state.opacity[:64].sum()
            return births, missed, alive, seen

        solution = simulate(
            scene, state, dt=DT, num_steps=STEPS, save_every=save_every, key=key, windows=windows, save=counts,
            step=symplectic_euler_step,
        )  # fmt: skip
        return solution.y

    arguments = scene, state, jax.random.key(0)
    start = time.perf_counter()
    compiled = jax.jit(end).lower(*arguments).compile()
    return (lambda: jax.block_until_ready(compiled(*arguments))), time.perf_counter() - start


def main() -> None:
    arguments(__doc__)
    full = pool(200_000)
    programs = {
        "5,000 particles, no pool": program(*plain()),
        "5,000 slots, none is born or dies": program(*pool(ALIVE, births=False)),
        "5,000 slots, the same births": program(*pool(ALIVE)),
        "5,500 slots, 300,000 used": program(*pool(ALIVE + 500)),
        'windows="auto", saved every 10 steps': program(*full, save_every=10, windows="auto"),
        'windows="auto", saved every 25 steps': program(*full, windows="auto"),
        'windows="auto", saved every 60 steps': program(*full, save_every=60, windows="auto"),
        "windows by hand (7168, 16384, 65536), 25 steps": program(*full, windows=(7_168, 16_384, 65_536)),
        "no windows": program(*full),
    }
    seconds: dict[str, list[float]] = {name: [] for name in programs}
    counts = {name: run() for name, (run, _) in programs.items() if name != "no windows"}
    for repeat in range(REPEATS):
        for name, (run, _) in programs.items():
            if name == "no windows" and repeat:
                continue  # slow, and beside the point
            start = time.perf_counter()
            counts[name] = run()
            seconds[name].append(time.perf_counter() - start)

    print(f"{platform.machine()}, {os.cpu_count()} CPUs, jax {jax.__version__}, float32, {STEPS} steps, {REPEATS} runs")
    print("\n| 200,000 slots where it says nothing else | particles used | alive at the end | missed | s to compile "
          "| us a step | of 5,000 still | of 5,000 with births | of 5,500 slots |\n"
          "|---|--:|--:|--:|--:|--:|--:|--:|--:|")  # fmt: skip
    medians = {name: statistics.median(times) for name, times in seconds.items()}
    baselines = [
        medians[name]
        for name in (
            "5,000 slots, none is born or dies", "5,000 slots, the same births", "5,500 slots, 300,000 used",
        )
    ]  # fmt: skip
    for name, median in medians.items():
        births, missed, alive = (int(x[-1]) for x in counts[name][:3])
        print(
            f"| {name} | {ALIVE + births:,} | {alive:,} | {missed} | {programs[name][1]:.1f} | "
            f"{1e6 * median / STEPS:.1f} | " + " | ".join(f"{median / x:.2f}" for x in baselines) + " |"
        )


if __name__ == "__main__":
    main()
