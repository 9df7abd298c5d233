"""One cloth over eight devices that JAX makes of this machine's cores, beside the same on one.

python benchmarks/divided.py cloth 512 [STEPS]        forward and gradient: differences, bytes sent, seconds
python benchmarks/divided.py fine 512 [STEPS]         rest lengths of 1 mm, which cancel in float32: both beside float64
python benchmarks/divided.py scaling 64               weak and strong scaling over 1 to 8 devices, of forward runs
"""

import dataclasses
import os
import subprocess
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np

import jeuler
from jeuler.meshes.bodies import grid
from jeuler.scenes.shapes import Body


def sheet(long: int, wide: int, apart: float) -> Body:
    """A level sheet of long x wide particles, so far apart, joined along its threads and across its meshes."""
    return Body(*grid((long, wide), (apart * (long - 1), apart * (wide - 1))))


@dataclasses.dataclass
class Cloth:
    apart: float  # m
    mass: float = 0.1
    kd: float = 0.1
    bending: float = 1e-4
    drag: float = 0.01
    dt: float = 1e-3
    ball: tuple[float, float, float] = (0.0, 0.0, -0.4)


FINE = Cloth(1e-3, 1e-3, 1e-3, 1e-9, 1e-4, 1e-4, (-0.056, -0.056, -0.1))


def problem(long: int, wide: int, num_steps: int, mesh=None, dtype=jnp.float32, of: Cloth | None = None):
    """The scene and state, and the function of (ks, position) that runs it."""
    of = of or Cloth(1 / (wide - 1))
    body, noise = sheet(long, wide, of.apart), np.random.default_rng(0)
    x = jnp.asarray(body.position + 0.01 * of.apart * noise.normal(size=body.position.shape), dtype)
    mass = jnp.full(len(x), of.mass, dtype).at[0].set(jnp.inf)
    state = jeuler.ParticleState(x, jnp.zeros_like(x), mass=mass)
    ks = jnp.full(len(body.edges), 20.0, dtype)

    def scene(ks):
        radius = -of.ball[2] - of.apart / 10 if of is FINE else 0.395
        ball = jeuler.PenaltyContact(jeuler.Sphere(list(of.ball), radius), ks=10.0)
        links = jeuler.Springs(body.edges, ks, of.kd, body.length), jeuler.Bending(body.lines, of.bending)
        return jeuler.Scene((*links, jeuler.Gravity([0.0, 0.0, -9.8]), jeuler.LinearDrag(of.drag), ball))

    def end(ks, x):
        how = {"dt": of.dt, "num_steps": num_steps, "save_every": num_steps, "step": jeuler.symplectic_euler_step}
        y = jeuler.simulate(scene(ks), state.replace(position=x), **how, mesh=mesh).y.position[-1]
        return jnp.sum(y**2), y

    return scene(ks), state, ks, end


def timed(function, *given):
    jax.block_until_ready(function(*given))
    start = np.array([time.perf_counter(), time.process_time()])
    found = jax.block_until_ready(function(*given))
    return found, np.array([time.perf_counter(), time.process_time()]) - start


def cloth(side: int, num_steps: int = 10) -> None:
    found = []
    for mesh in (None, jax.make_mesh((8,), ("device",))):
        scene, state, ks, end = problem(side, side, num_steps, mesh)
        function = jax.jit(jax.value_and_grad(end, argnums=(0, 1), has_aux=True))
        ((_, y), gradient), (seconds, _) = timed(function, ks, state.position)
        print(
            f"{'undivided' if mesh is None else '8 devices'}: value and gradient of {num_steps} steps {seconds:.2f} s"
        )
        found.append((y, *gradient))
    for name, a, b in zip(("positions", "by ks", "by position"), *found, strict=True):
        print(f"{name:12s} differ by {float(jnp.abs(a - b).max() / jnp.abs(a).max()):.1e} of the largest")
    print(jeuler.divide(scene, state, devices=8))
    print(f"on paper: {2 * side * 7 * 2 * 6 * 4:,} bytes")


def fine(side: int, num_steps: int = 10) -> None:
    jax.config.update("jax_enable_x64", True)
    found = {}
    for dtype in (jnp.float64, jnp.float32):
        for name, mesh in (("undivided", None), ("divided", jax.make_mesh((8,), ("device",)))):
            _, state, ks, end = problem(side, side, num_steps, mesh, dtype, FINE)
            (_, y), gradient = jax.jit(jax.value_and_grad(end, argnums=(0, 1), has_aux=True))(ks, state.position)
            found[f"{name} {dtype.__name__}"] = [np.asarray(one, float) for one in (y, *gradient)]
    pairs = (
        ("divided float32", "undivided float32"),
        ("divided float32", "undivided float64"),
        ("undivided float32", "undivided float64"),
        ("divided float64", "undivided float64"),
    )
    for pair in pairs:
        a, b = (found[name] for name in pair)
        off = [f"{np.abs(x - y).max() / np.abs(y).max():.1e}" for x, y in zip(a, b, strict=True)]
        print(f"{' - '.join(pair):42s} positions {off[0]}, by ks {off[1]}, by position {off[2]}")


def scaling(rows_each: int) -> None:
    for devices in (1, 2, 4, 8):
        flags = f"--xla_force_host_platform_device_count={devices}"
        for kind, long in (("weak", rows_each * devices), ("strong", 8 * rows_each)):
            command = [sys.executable, __file__, "on", kind, str(devices), str(long)]
            subprocess.run(command, env=os.environ | {"XLA_FLAGS": flags}, check=True)


def on(kind: str, devices: str, long: str) -> None:
    wide, num_steps = 128, 20
    mesh = jax.make_mesh((int(devices),), ("device",))
    scene, state, ks, end = problem(int(long), wide, num_steps, mesh)
    function = jax.jit(lambda *given: end(*given)[1])
    timed(function, ks, state.position)
    wall, cpu = np.min([timed(function, ks, state.position)[1] for _ in range(5)], axis=0) / num_steps
    print(
        f"{kind:6s} {devices} devices, {int(long) * wide:,} particles: {1e3 * wall:.2f} ms a step, "
        f"{1e3 * cpu:.2f} ms of CPU, {1e9 * cpu / len(ks):.0f} ns of CPU a spring-step, "
        f"{jeuler.divide(scene, state, devices=int(devices)).bytes_sent:,} bytes a step",
        flush=True,
    )


if __name__ == "__main__":
    task, *rest = sys.argv[1:]
    if task in ("cloth", "fine") and "force_host" not in os.environ.get("XLA_FLAGS", ""):
        flags = "--xla_force_host_platform_device_count=8"
        sys.exit(subprocess.run([sys.executable, *sys.argv], env=os.environ | {"XLA_FLAGS": flags}).returncode)
    if task == "on":
        on(*rest)
    else:
        {"cloth": cloth, "fine": fine, "scaling": scaling}[task](*map(int, rest))
