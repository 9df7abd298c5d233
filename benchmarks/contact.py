"""Contact in numbers: against exact motions from event to event, and gradients of 2,000 scenes of round numbers.

python benchmarks/contact.py exact [scenes]
python benchmarks/contact.py fuzz [scenes] [seed] [beginning of a shape's name] [grid, m] [step]
python benchmarks/contact.py heap [steps]
"""

import collections
import itertools
import pathlib
import sys
import time

import jax
import numpy as np
from arguments import REQUIRED, arguments

sys.path[:0] = [str(pathlib.Path(__file__).resolve().parent.parent / "tests" / name) for name in ("", "contact")]
import contact_scenes  # noqa: E402

import jeuler  # noqa: E402

AT_ONCE = 256  # runs in one call


def fuzz(scenes, seed, only, grid, steps):
    """Each shape, float type and step: wrong gradients, whether announced, and rises of energy."""
    shapes = [shape for shape in contact_scenes.SHAPES if shape.startswith(only)]
    steps = [name for name in contact_scenes.STEPS if steps in ("", name)]
    each = -(-scenes // (2 * len(shapes) * len(steps)))
    total = collections.Counter()
    for shape, dtype in itertools.product(shapes, (np.float64, np.float32)):
        for step in steps:
            total += fuzz_row(shape, dtype, step, each, seed, grid)
        contact_scenes.programs.cache_clear()  # all of them at once are more code than a process may hold
        jax.clear_caches()
    print(dict(total))


def fuzz_row(shape, dtype, step, each, seed, grid):
    number = list(contact_scenes.STEPS).index(step)
    random = np.random.default_rng([seed, *shape.encode(), number, np.dtype(dtype).itemsize])
    begin = time.process_time()
    steps = contact_scenes.APART if step in contact_scenes.APART else contact_scenes.TOGETHER
    value, reverse, forward = contact_scenes.programs(shape, steps)
    method = steps.index(step)
    drawn = [contact_scenes.draw(random, shape, grid) for _ in range(each)]
    numbers = contact_scenes.batch(drawn, dtype)
    numbers["direction"] = random.normal(size=(each, 2, *numbers["position"].shape[1:])).astype(dtype)
    _, runs, gradient = contact_scenes.in_chunks(reverse, numbers, method, 32)
    position, velocity, unresolved, nonfinite = runs
    along = contact_scenes.in_chunks(forward, numbers, method, 32)
    slopes = contact_scenes.differences(value, numbers, method, AT_ONCE)
    wrong_parts = contact_scenes.wrong_gradients(gradient, slopes)
    if dtype == np.float32 and wrong_parts.any():  # to its accuracy the two sides of a kink may look alike
        k = np.flatnonzero(wrong_parts.any(axis=(1, 2, 3)))
        exact = contact_scenes.batch([drawn[n] for n in k], np.float64)
        wrong_parts[k] &= contact_scenes.agree(contact_scenes.differences(value, exact, method, AT_ONCE))
    rise, allowed = contact_scenes.rise_of_energy(numbers, position, velocity, step)
    found = {
        "wrong gradient": wrong_parts.any(axis=(1, 2, 3)),
        "modes disagree": contact_scenes.disagree(gradient, numbers, along),
        "energy rises": ~(rise <= allowed),
        "not finite": nonfinite >= 0,
    }
    announced = (unresolved > 0) | (nonfinite >= 0)
    for k in np.flatnonzero(np.any(list(found.values()), axis=0)):
        what = [name for name, there in found.items() if there[k]]
        print(f"  {what}, {'announced' if announced[k] else 'SILENT'}: {shape}, {np.dtype(dtype)}, {step}")
        print("   ", {key: x[k].round(6).tolist() for key, x in numbers.items() if key != "direction"})
        if found["wrong gradient"][k]:
            print(f"    gradient {gradient[k].round(4).tolist()}, differences {slopes[:, k].mean(0).round(4).tolist()}")
        if found["energy rises"][k]:
            print(f"    by {rise[k]:.2g} of {allowed[k]:.2g} J")
    right = ~(found["wrong gradient"] | found["modes disagree"] | found["energy rises"])
    counts = {
        "scenes": each,
        "announced": int(announced.sum()),
        "announced though right": int((announced & right).sum()),
    }
    for name, there in found.items():
        counts[name] = int(there.sum())
        counts[name + ", silent"] = int((there & ~announced).sum())
    shown = ", ".join(f"{name} {count}" for name, count in counts.items() if count)
    print(f"{shape}, {np.dtype(dtype)}, {step}: {shown}; {time.process_time() - begin:.0f} s of CPU", flush=True)
    return collections.Counter(counts)


def exact(scenes):
    """The largest errors against exact motions, and how they fall with the step."""
    import event_driven
    import test_exact as exact_test

    random = np.random.default_rng(1)
    drawn = event_driven.random_scenes(random, scenes, exact_test.DURATION, exact_test.DT)
    for step, position, unresolved in exact_test.at_both(
        drawn, steps=tuple(contact_scenes.STEPS.values()), balls=5, planes=4
    ):
        compared = [exact_test.compare(scene, step, position[:, k]) for k, scene in enumerate(drawn)]
        exactly = [own for _, errors in compared for _, own, slow in errors if not slow]
        cut = [max(own for _, own, _ in errors) for _, errors in compared if any(slow for *_, slow in errors)]
        cut_half = [errors[1][1] for _, errors in compared if any(slow for *_, slow in errors)]
        whole, half = np.array([[error for error, *_ in errors] for _, errors in compared]).T
        print(
            f"{step.__name__}: error from the exact motion, median {np.median(whole):.2g} m, at half the step "
            f"{np.median(half):.2g} m, most {whole.max():.2g} and {half.max():.2g} m; from the step's own parabola "
            f"{max(exactly):.1g} m ({len(exactly)} runs), where bounces are cut short mean {np.mean(cut):.2g} and "
            f"{np.mean(cut_half):.2g} m ({len(cut)} scenes); unresolved in {int((unresolved > 0).any(axis=0).sum())}"
        )


def heap(steps, balls=150, radius=0.1, dt=1 / 60):
    """Heaps between walls, all pairs named: one packed and let go at rest, one that falls together first."""
    row, column = np.divmod(np.arange(balls), 15)
    packed = np.stack([radius * (1 + row % 2 + 2 * column), radius * (1 + np.sqrt(3) * row)], axis=1)
    loose = np.stack([0.11 + 0.25 * column + 0.01 * (row % 2), 0.11 + 0.21 * row], axis=1)
    for name, position, width in (("packed", packed, 3.1), ("falls together", loose, 3.72)):
        walls = [([0.0, 0.0], [0.0, 1.0]), ([0.0, 0.0], [1.0, 0.0]), ([width, 0.0], [-1.0, 0.0])]
        contact = jeuler.Collisions(
            tuple(jeuler.Plane(*wall) for wall in walls),
            pairs=np.stack(np.triu_indices(balls, 1), 1),
            radius=radius,
            restitution=0.3,
            friction=0.3,
        )
        scene = jeuler.Scene((jeuler.Gravity([0.0, -9.8]),), (contact,))
        run = jax.jit(
            lambda state, scene=scene: jeuler.simulate(
                scene, state, dt=dt, num_steps=steps, save_every=steps, step=jeuler.symplectic_euler_step
            )
        )
        state = jeuler.ParticleState(position, np.zeros_like(position))
        middle = jax.block_until_ready(run(state))
        state = jeuler.ParticleState(middle.y.position[-1], middle.y.velocity[-1])
        begin, spent = time.perf_counter(), time.process_time()
        end = jax.block_until_ready(run(state))
        moved = np.abs(end.y.position[-1] - state.position).max()
        wall, cpu = (
            1e3 * (now - then) / steps for now, then in ((time.perf_counter(), begin), (time.process_time(), spent))
        )
        print(
            f"{name}: after {steps} steps at most {np.abs(middle.y.velocity[-1]).max():.2g} m/s, unresolved "
            f"{int(middle.unresolved_contacts)}; in as many more moved {moved:.2g} m, "
            f"unresolved {int(end.unresolved_contacts)}, {wall:.2f} ms a step ({cpu:.2f} ms of CPU)",
            flush=True,
        )


def main():
    given = arguments(__doc__, what=REQUIRED, scenes=None, seed="0", shape="", grid="0.1", step="")
    jax.config.update("jax_enable_x64", True)
    if given.what == "exact":
        exact(int(given.scenes or 100))
    elif given.what == "heap":
        heap(int(given.scenes or 120))
    elif given.what == "fuzz":
        fuzz(int(given.scenes or 2000), int(given.seed), given.shape, float(given.grid), given.step)
    else:
        raise SystemExit(__doc__)


if __name__ == "__main__":
    main()
