"""Long runs on disk: killed at random moments, on a full disk, and the memory of many frames.

python benchmarks/long_runs.py kills 20      kill -9 at so many random moments; the result beside a run in one go
python benchmarks/long_runs.py full          a disk that takes no more (ulimit -f)
python benchmarks/long_runs.py progress 3    some seconds with a bar and without, in turn so many times: CPU time
python benchmarks/long_runs.py memory 1000   as many steps a frame, 1e4 frames of 1,000 particles: resident memory
"""

import os
import pathlib
import random
import resource
import subprocess
import sys
import tempfile
import time

import jax
import jax.numpy as jnp
import numpy as np

import jeuler

STEPS = 400_000


def fountain(num_steps, **how):
    jet = jeuler.Emitter(60.0, [0.0, 0.0], jeuler.Normal(0.0, jnp.ones(2)), max_births=2)
    scene = jeuler.Scene((jeuler.Gravity([0.0, -9.8]),), (jet, jeuler.Lifetime(0.4)))
    pool = jeuler.empty_pool(64, 2)
    key = jax.random.key(0)
    return jeuler.simulate(scene, pool, dt=0.01, num_steps=num_steps, save_every=100, key=key, **how)


def kills(count):
    with tempfile.TemporaryDirectory() as folder:
        path = pathlib.Path(folder) / "run"
        subprocess.run([sys.executable, __file__, "child", path], check=True)
        expected = jax.tree.map(np.asarray, fountain(STEPS, resume=path).y)
        rng, same, killed = random.Random(0), 0, 0
        for n in range(count):
            path = pathlib.Path(folder) / f"killed{n}"
            child = subprocess.Popen([sys.executable, __file__, "child", path])
            while not path.exists() and child.poll() is None:
                time.sleep(0.01)
            time.sleep(rng.uniform(0, 1.5))
            killed += child.poll() is None
            child.kill()
            child.wait()
            found = jax.tree.map(np.asarray, fountain(STEPS, resume=path).y)
            pairs = zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True)
            same += all(np.array_equal(a, b) for a, b in pairs)
        print(f"{count} runs, {killed} killed before their end, {same} of them bit-identical")


def full():
    with tempfile.TemporaryDirectory() as folder:
        path = pathlib.Path(folder) / "run"
        fountain(1_000, resume=path)
        _, most = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (4096, most))
        try:
            fountain(200_000, resume=path)
        except OSError as error:
            print(f"OSError: {error}")
        resource.setrlimit(resource.RLIMIT_FSIZE, (most, most))
        found = fountain(1_000, resume=path)
        print(f"last good state readable: {found.y.position}")


def progress(times=3):
    """CPU seconds, which other programs disturb less."""

    def run(bar):
        how = {"dt": 1e-6, "num_steps": 1_000_000_000, "save_every": 100_000_000, "progress": bar}
        return jeuler.solve(lambda t, y, a: (y[1], -y[0]), (1.0, 0.0), **how)

    seconds = {None: [], True: []}
    for n in range(times + 1):
        for bar in seconds:
            start = time.process_time()
            jax.block_until_ready(run(bar).t)
            if n:  # the first one compiles
                seconds[bar].append(time.process_time() - start)
    without, with_bar = (np.median(seconds[bar]) for bar in (None, True))
    print(f"{without:.2f} s of CPU, with a bar {with_bar:.2f} s, {with_bar / without - 1:+.1%}", seconds)


def memory(save_every=1000):
    rng = np.random.default_rng(0)
    state = jeuler.ParticleState(rng.normal(size=(1000, 3)), np.zeros((1000, 3)))
    scene = jeuler.Scene((jeuler.PointAttractor([0.0, 0.0, 0.0], 1.0, softening=0.5),))
    kib = []

    def resident(step, num_steps):
        if step > num_steps / 10:  # frames have gone to disk
            pages = int(pathlib.Path("/proc/self/statm").read_text().split()[1])
            kib.append(pages * os.sysconf("SC_PAGE_SIZE") / 1024)

    with tempfile.TemporaryDirectory() as folder:
        how = {
            "dt": 1e-4,
            "num_steps": save_every * 10_000,
            "save_every": save_every,
            "step": jeuler.symplectic_euler_step,
        }
        start = time.perf_counter()
        run = jeuler.simulate(scene, state, **how, resume=pathlib.Path(folder) / "run", progress=resident)
        seconds = time.perf_counter() - start
        spread = (max(kib) - min(kib)) / min(kib)
        print(f"{run.y.position}, {seconds:.0f} s, {min(kib) / 1024:.0f} to {max(kib) / 1024:.0f} MiB, {spread:.1%}")


if __name__ == "__main__":
    task, *rest = sys.argv[1:]
    if task == "child":
        fountain(STEPS, resume=rest[0], checkpoint_every=5_000)
    else:
        {"kills": kills, "full": full, "progress": progress, "memory": memory}[task](*map(int, rest))
