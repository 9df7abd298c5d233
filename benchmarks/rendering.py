"""How long a film takes to draw and to write: python benchmarks/rendering.py [FOLDER]

10,000 particles with colours, opacities and sizes of their own, 200 frames of 480 x 360 pixels, in 2-D and in 3-D.
"""

import os
import pathlib
import platform
import shutil
import tempfile
import time

import jax
import matplotlib
import numpy as np
from arguments import arguments

matplotlib.use("Agg")

from jeuler import ParticleState, Solution
from jeuler.plotting import animate

PARTICLES, FRAMES = 10_000, 200


def swirl(dim: int) -> Solution:
    """Particles that circle, each at its own height, radius, pace, colour and size."""
    random = np.random.default_rng(0)
    start, pace = random.uniform(0, 2 * np.pi, PARTICLES), random.uniform(0.5, 2, PARTICLES)
    angle = start + pace * np.linspace(0, 3, FRAMES)[:, None]
    radius = random.uniform(0.2, 1, PARTICLES)
    position = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)
    if dim == 3:
        height = np.broadcast_to(random.uniform(0, 1, (PARTICLES, 1)), (FRAMES, PARTICLES, 1))
        position = np.concatenate([position, height], axis=-1)

    def still(x):
        return np.broadcast_to(x, (FRAMES, *x.shape))

    y = ParticleState(
        position, 0 * position, np.ones(FRAMES), color=still(random.uniform(size=(PARTICLES, 3))),
        opacity=still(random.uniform(0.3, 1, PARTICLES)), size=still(random.uniform(0.005, 0.02, PARTICLES)),
    )  # fmt: skip
    return Solution(np.arange(FRAMES) / 25, y, np.int32(-1))


def main() -> None:
    folder = pathlib.Path(arguments(__doc__, folder=None).folder or tempfile.mkdtemp())
    endings = ["gif", "html", *(["mp4"] if shutil.which("ffmpeg") else [])]
    print(f"{platform.machine()}, {os.cpu_count()} CPUs, matplotlib {matplotlib.__version__}, jax {jax.__version__}")
    print(f"{PARTICLES} particles, {FRAMES} frames\n\n| film | s | MB |\n|---|--:|--:|")
    for dim in (2, 3):
        for ending in endings:
            path = folder / f"swirl{dim}.{ending}"
            start = time.perf_counter()
            animate(swirl(dim), path=path, progress=False)
            seconds = time.perf_counter() - start
            print(f"| {dim}-D {ending} | {seconds:.0f} | {path.stat().st_size / 1e6:.0f} |", flush=True)
    if "mp4" not in endings:
        print("\nno mp4: there is no ffmpeg on the PATH")


if __name__ == "__main__":
    main()
