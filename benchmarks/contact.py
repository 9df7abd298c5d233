"""Contact in numbers: against exact motions from event to event, and gradients of 2,000 scenes of round numbers.

python benchmarks/contact.py exact [scenes]
python benchmarks/contact.py fuzz [scenes] [seed] [part of a shape's name]
python benchmarks/contact.py heap [steps]
"""

import collections
import pathlib
import sys
import time

import jax
import numpy as np
from arguments import REQUIRED, arguments

sys.path[:0] = [str(pathlib.Path(__file__).resolve().parent.parent / "tests" / name) for name in ("", "contact")]
import contact_scenes  # noqa: E402

import jeuler  # noqa: E402


def fuzz(scenes, seed, only):
    """Each shape, float type and step: wrong gradients, whether announced, and rises of energy."""
    shapes = [shape for shape in contact_scenes.SHAPES if only in shape]
    rows = [(s, t, m) for s in shapes for t in (np.float64, np.float32) for m in range(len(contact_scenes.STEPS))]
    each = -(-scenes // len(rows))
    total = collections.Counter()
    for shape, dtype, method in rows:
        total += fuzz_row(shape, dtype, method, each, seed)
    print(dict(total))
    return total


def fuzz_row(shape, dtype, method, each, seed):
    random = np.random.default_rng([seed, *shape.encode(), method, np.dtype(dtype).itemsize])
    begin = time.perf_counter()
    whole, value, gradients, _ = contact_scenes.programs(shape)
    drawn = [contact_scenes.draw(random, shape) for _ in range(each)]
    numbers = contact_scenes.batch(drawn, dtype)
    position, velocity, unresolved, nonfinite = contact_scenes.in_chunks(whole, numbers, method, 16)
    gradient = contact_scenes.in_chunks(gradients, numbers, method, 16)
    gradient = np.stack([gradient["position"], gradient["velocity"]], axis=1)
    slopes = contact_scenes.differences(value, numbers, method, 256)
    wrong = contact_scenes.wrong_gradients(gradient, slopes).any(axis=(1, 2, 3))
    rise, allowed = contact_scenes.rise_of_energy(numbers, position, velocity, method)
    rises = ~(rise <= allowed)
    announced = (unresolved > 0) | (nonfinite >= 0)
    name = list(contact_scenes.STEPS)[method]
    for k in np.flatnonzero(wrong | rises):
        shown = {key: x[k].tolist() for key, x in numbers.items()}
        what = ("wrong" if wrong[k] else "") + (f" rises {rise[k]:.2g} of {allowed[k]:.2g} J" if rises[k] else "")
        print(
            f"  {what}, {'announced' if announced[k] else 'SILENT'}: {shape}, {name}, {np.dtype(dtype)}, {k}: {shown}"
        )
    counts = {
        "scenes": each,
        "wrong gradient": int(wrong.sum()),
        "wrong and silent": int((wrong & ~announced).sum()),
        "energy rises": int(rises.sum()),
        "energy rises, silent": int((rises & ~announced).sum()),
        "announced": int(announced.sum()),
        "not finite": int((nonfinite >= 0).sum()),
    }
    seconds = time.perf_counter() - begin
    print(f"{shape}, {np.dtype(dtype)}, {name}: {counts} {seconds:.1f} s", flush=True)
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
    given = arguments(__doc__, what=REQUIRED, scenes=None, seed="0", shape="")
    jax.config.update("jax_enable_x64", True)
    if given.what == "exact":
        exact(int(given.scenes or 100))
    elif given.what == "heap":
        heap(int(given.scenes or 120))
    elif given.what == "fuzz":
        fuzz(int(given.scenes or 2000), int(given.seed), given.shape)
    else:
        raise SystemExit(__doc__)


if __name__ == "__main__":
    main()
