"""The Euler family on one spring net: error against seconds, as a figure and a table.

    python benchmarks/work_precision.py            # docs/work_precision.png, .md and .csv
    python benchmarks/work_precision.py --few      # the seconds of 24 rows

A hanging net of 6 x 6 particles, structural and shear springs with damping, its top corners pinned, swings for half a
second. The reference is diffrax's Dopri8 at tolerance 1e-13 in float64. The last line is what `advise_method` says of
the net at an error of 1e-3, in float64.
"""

import argparse
import pathlib
import time

import diffrax
import jax
import jax.numpy as jnp
import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt

import jeuler
from jeuler.accuracy import Compensated, work_precision
from jeuler.steps.extrapolated import extrapolated_euler
from jeuler.steps.implicit import implicit_euler_step, linearly_implicit_euler_step

ROOT = pathlib.Path(__file__).resolve().parent.parent


def spring_net(side: int = 6):
    """Scene, position and mass of a square net with both diagonals, hung by two corners."""
    index = np.arange(side * side).reshape(side, side)
    pairs = [(index[:-1], index[1:]), (index[:, :-1], index[:, 1:])]
    pairs += [(index[:-1, :-1], index[1:, 1:]), (index[:-1, 1:], index[1:, :-1])]
    edges = np.concatenate([np.stack([a.ravel(), b.ravel()], axis=1) for a, b in pairs])
    row, column = np.divmod(np.arange(side * side), side)
    position = np.stack([column, 0.0 * row, -row], axis=1) / (side - 1)  # m
    rest_length = np.linalg.norm(position[edges[:, 0]] - position[edges[:, 1]], axis=1)
    mass = np.full(side * side, 0.01)  # kg
    mass[[0, side - 1]] = np.inf
    scene = jeuler.Scene(
        forces=(
            jeuler.Gravity([0.0, 5.0, -9.8]),
            jeuler.Springs(edges, ks=40.0, kd=0.02, rest_length=rest_length),
        )
    )
    return scene, position, mass


def methods():
    """Every method of the figure, by the name it has there."""
    return {
        "explicit Euler": jeuler.euler_step,
        "compensated Euler": Compensated(jeuler.euler_step),
        "symplectic Euler": jeuler.symplectic_euler_step,
        "implicit Euler": implicit_euler_step,
        "linearly implicit Euler": linearly_implicit_euler_step,
        "extrapolated Euler, order 6": extrapolated_euler(6),
        "Heun": jeuler.heun_step,
        "RK4": jeuler.rk4_step,
        "diffrax Euler": diffrax.Euler(),
        "diffrax Tsit5": diffrax.Tsit5(),
    }


def sweep(dts, dtypes=("float32", "float64"), tolerances=(1e-4, 1e-6), timeout=1.0):
    """The table of the figure."""
    scene, position, mass = spring_net()
    y0 = jnp.asarray(position), jnp.zeros(position.shape)

    def field(t, y, args):
        scene, mass = args
        return scene.vector_field(t, y, mass)

    return work_precision(
        field,
        y0,
        t1=0.5,
        dts=dts,
        steps=methods(),
        args=(scene, mass),
        dtypes=dtypes,
        tolerances=tolerances,
        repeats=3,
        timeout=timeout,
    )


def advice():
    """In one line which step to use, and its milliseconds."""
    jax.config.update("jax_enable_x64", True)
    scene, position, mass = spring_net()
    state = jeuler.ParticleState(jnp.asarray(position), jnp.zeros(position.shape), jnp.asarray(mass))
    return jeuler.advise_method(scene, state, t1=0.5, error=1e-3).reason


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--folder", type=pathlib.Path, default=ROOT / "docs", help="where the figure and table go")
    parser.add_argument("--few", action="store_true", help="24 rows in float64 and their seconds; writes nothing")
    asked = parser.parse_args()
    folder, begun = asked.folder, time.perf_counter()
    if asked.few:
        table = sweep(dts=[0.5 / n for n in (500, 2500)], dtypes=("float64",), tolerances=(1e-4, 1e-6))
        print(f"{len(table.rows)} rows in {time.perf_counter() - begun:.0f} s, {time.process_time():.0f} s of CPU")
        return
    table = sweep(dts=[0.5 / n for n in (100, 500, 2500, 12500)])
    seconds = time.perf_counter() - begun
    folder.mkdir(parents=True, exist_ok=True)
    table.plot()
    plt.savefig(folder / "work_precision.png", dpi=100)
    table.to_csv(folder / "work_precision.csv")
    (folder / "work_precision.md").write_text(table.to_markdown() + "\n")
    print(table.to_markdown())
    for summary in table.summary:
        print(summary)
    print(f"reference trusted to {table.reference_error:.1e}; {len(table.rows)} runs in {seconds:.0f} s")
    print(advice())


if __name__ == "__main__":
    main()
