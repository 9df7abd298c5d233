"""How long a first answer takes: whole processes, from an empty and from a warm compilation cache.

    python benchmarks/first_answer.py             a table; about ten minutes on two cores
    python benchmarks/first_answer.py solve fit   these rows alone

jax-md's bonds have no dampers: less work. Warp's cache is in the same folder. The fit of four springs is that of
`benchmarks/fits_mujoco.py 3`, imports included.

Each figure is of processes of their own, medians of `ROUNDS`: seconds by the clock, seconds of CPU, programs compiled.
"""

from __future__ import annotations

import importlib.util
import os
import re
import resource
import statistics
import subprocess
import sys
import tempfile
import time

ROUNDS = 3
COUNTED = """
import atexit, sys, jax
programs = []
jax.monitoring.register_event_duration_secs_listener(
    lambda name, seconds, **_: programs.append(name) if name == "/jax/core/compile/backend_compile_duration" else None)
atexit.register(lambda: print("programs", len(programs), file=sys.stderr))
"""
FIELD = "import jax, jax.numpy as jnp\ndef f(t, y, args): return jnp.array([y[1], -y[0] - args * y[1]])\n"
SOLVE = "print(jeuler.solve(f, jnp.array([1., 0.]), dt=0.01, num_steps=1000, save_every=1000, args=0.1).y[-1])"
DIFFRAX = """import diffrax
print(diffrax.diffeqsolve(diffrax.ODETerm(f), diffrax.Euler(), 0., 10., 0.01, jnp.array([1., 0.]), args=0.1).ys[-1])
"""
NET = """
import numpy as np
n = 64
k = np.arange(n * n).reshape(n, n)
pairs = [(k[:-1], k[1:]), (k[:, :-1], k[:, 1:]), (k[:-1, :-1], k[1:, 1:]), (k[1:, :-1], k[:-1, 1:])]
edges = np.concatenate([np.stack([a.ravel(), b.ravel()], 1) for a, b in pairs])
start = np.stack([*np.meshgrid(np.arange(n), np.arange(n), indexing="ij"), np.zeros((n, n))], -1).reshape(-1, 3)
"""
CLOTH = (
    NET
    + """
import jeuler
state = jeuler.ParticleState(jnp.asarray(start, jnp.float32), jnp.zeros((n * n, 3), jnp.float32))
def run(ks):
    scene = jeuler.Scene((jeuler.Gravity([0., 0., -9.81]), jeuler.Springs(edges, ks, 0.1, 1.0)))
    return jeuler.simulate(scene, state, dt=1e-3, num_steps=100, save_every=100).y.position[-1]
"""
)
WARP = """
import warp as wp, warp_kernels as kernels
wp.config.quiet = True
single = lambda k: wp.array([k], dtype=float, device="cpu", requires_grad=True)
vectors = lambda x: wp.array(x, dtype=wp.vec3, device="cpu", requires_grad=True)
ks, kd, loss = single(1000.), single(0.1), single(0.)
ends = wp.array(edges, dtype=wp.vec2i, device="cpu")
rest = wp.array(np.ones(len(edges)), dtype=float, device="cpu")
def run():
    x, v = vectors(start), vectors(0 * start)
    for _ in range(100):
        f, then = vectors(0 * start), (vectors(0 * start), vectors(0 * start))
        wp.launch(kernels.spring_forces, len(edges), inputs=[x, v, ends, rest, ks, kd, f], device="cpu")
        wp.launch(kernels.move, len(start), inputs=[x, v, f, *then, 1e-3, 9.81, 0.0], device="cpu")
        x, v = then
    return x
"""
WARP_GRADIENT = """
with wp.Tape() as tape:
    wp.launch(kernels.sum_of_squares, len(start), inputs=[run(), loss], device="cpu")
tape.backward(loss)
print(ks.grad.numpy())
"""
CHAIN = """
import numpy as np, scipy.linalg
from fits_mujoco import by_jeuler, by_mujoco, chain
x, v, ks, kd = chain(3)
stiff, damp = (np.diag(k[:-1] + k[1:]) - np.diag(k[1:-1], 1) - np.diag(k[1:-1], -1) for k in (ks, kd))
step = scipy.linalg.expm(0.01 * np.block([[np.zeros((3, 3)), np.eye(3)], [-stiff, -damp]]))
states = [np.concatenate([np.zeros(3), v[1:-1]])]
for _ in range(400):
    states.append(step @ states[-1])
y = x[1:-1] + np.array(states)[:, :3] + 1e-3 * np.random.default_rng(1).normal(size=(401, 3))
"""
JAX_MD = """
from jax_md import energy, space
displacement, shift = space.free()
def run(ks):
    bonds = lambda x: energy.simple_spring_bond(displacement, jnp.asarray(edges), length=1., epsilon=ks, alpha=2.)(x)
    def step(y, _):
        x, v = y
        return (shift(x, 1e-3 * v), v - 1e-3 * (jax.grad(bonds)(x) + jnp.array([0., 0., 9.81]))), None
    return jax.lax.scan(step, (state.position, state.velocity), None, length=100)[0][0]
"""
DECAY = """
import numpy as np
times = np.arange(50) * 0.1
data = np.exp(-0.7 * times)
"""
FIT = """import jeuler
def residual(p):
    return jeuler.solve(lambda t, y, k: -k * y, jnp.asarray(1.0), dt=0.1, num_steps=49, args=p["k"],
                        step=jeuler.rk4_step).y - data
print(jeuler.fit(residual, {"k": 1.0}).params)
"""
SCIPY = """import scipy.optimize
from scipy.integrate import solve_ivp
print(scipy.optimize.least_squares(
    lambda k: solve_ivp(lambda t, y: -k * y, (0, 4.9), [1.0], t_eval=times, rtol=1e-8).y[0] - data, 1.0).x)
"""
ROWS = {
    "import jax": "import jax",
    "import jeuler": "import jeuler",
    "solve": FIELD + "import jeuler\n" + SOLVE,
    "solve, diffrax": FIELD + DIFFRAX,
    "simulate": FIELD + CLOTH + "print(run(1000.)[0])",
    "gradient": FIELD + CLOTH + "print(jax.grad(lambda ks: jnp.sum(run(ks) ** 2))(1000.))",
    "simulate, jax-md": FIELD + CLOTH + JAX_MD + "print(run(1000.)[0])",
    "gradient, jax-md": FIELD + CLOTH + JAX_MD + "print(jax.grad(lambda ks: jnp.sum(run(ks) ** 2))(1000.))",
    "simulate, Warp": NET + WARP + "print(run().numpy()[0])",
    "gradient, Warp": NET + WARP + WARP_GRADIENT,
    "fit": FIELD + DECAY + FIT,
    "fit, SciPy": DECAY + SCIPY,
    "fit of four springs": CHAIN + "import jax\njax.config.update('jax_enable_x64', True)\nprint(by_jeuler(x, v, y))",
    "fit of four springs, mujoco": CHAIN + "print(by_mujoco(x, v, y))",
    "command line": "import sys\nsys.argv = ['jeuler', 'fit', '--plot', 'out.png']\n"
    "from jeuler.__main__ import main\nmain()",
}
PEERS = {"diffrax": "diffrax", "jax-md": "jax_md", "SciPy": "scipy", "Warp": "warp", "mujoco": "mujoco"}


def path_with(folder: str) -> str:
    """The search path of modules with this folder, in which the kernels of Warp and the fits of chains are."""
    return os.pathsep.join([os.path.abspath(folder), *filter(None, [os.environ.get("PYTHONPATH")])])


def once(source: str, cache: str) -> tuple[float, float, int]:
    """Seconds by the clock, seconds of CPU, and programs compiled or read, of one process."""
    source = COUNTED + source if re.search(r"^import (jax|jeuler)", source, re.MULTILINE) else source
    environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": cache, "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
    environment |= {"WARP_CACHE_PATH": os.path.join(cache, "warp"), "PYTHONPATH": path_with(os.path.dirname(__file__))}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-c", source], env=environment, cwd=cache, capture_output=True, text=True, check=False
    )
    seconds, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode:
        raise RuntimeError(done.stderr)
    counts = [line.split()[1] for line in done.stderr.splitlines() if line.startswith("programs ")]
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return seconds, cpu, int(counts[0]) if counts else 0


def row(name: str) -> str:
    """The medians of a row, from an empty and from a warm cache."""
    cold, warm = [], []
    for _ in range(ROUNDS):
        with tempfile.TemporaryDirectory() as cache:
            cold.append(once(ROWS[name], cache))
            warm.append(once(ROWS[name], cache))
    cells = [f"{statistics.median(x):.2f}" for runs in (cold, warm) for x in list(zip(*runs, strict=True))[:2]]
    return f"| {name} | {' | '.join(cells)} | {cold[0][2]} |"


if __name__ == "__main__":
    print("| | empty cache, s | of CPU | warm cache, s | of CPU | programs |\n|---|--:|--:|--:|--:|--:|")
    for name in sys.argv[1:] or ROWS:
        peer = name.rpartition(", ")[2]
        if peer not in PEERS or importlib.util.find_spec(PEERS[peer]):
            print(row(name), flush=True)
