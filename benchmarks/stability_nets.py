"""stability_limit on random spring nets against a bisection by long runs of each step.

    python benchmarks/stability_nets.py [nets, 200]

Nets of 3 to 10 particles in two and three dimensions; masses, ks and kd drawn, kd 0 in one net of four; rest lengths up
to 5 % short; the first particle pinned. The run is that of the step itself on the linearised equation, 2^40 steps by
repeated squaring of its matrix; it is unstable where its norm grows more from 2^39 to 2^40 steps than that of a drift,
which doubles.
"""

import collections
import functools

import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
from arguments import arguments

import jeuler

STEPS = {
    "euler": jeuler.euler_step,
    "symplectic_euler": jeuler.symplectic_euler_step,
    "heun": jeuler.heun_step,
    "rk4": jeuler.rk4_step,
    "extrapolated_euler(3)": jeuler.extrapolated_euler(3),
    "implicit_euler": jeuler.implicit_euler_step,
    "linearly_implicit_euler": jeuler.linearly_implicit_euler_step,
}


def net(seed):
    """A scene and its state at rest."""
    random = np.random.default_rng(seed)
    count, dim = int(random.integers(3, 11)), int(random.integers(2, 4))
    x = random.normal(size=(count, dim))
    edges = [(i, j) for i in range(count) for j in range(i) if j == i - 1 or random.random() < 0.4]
    length = np.array([np.linalg.norm(x[i] - x[j]) for i, j in edges]) * (1 - 0.05 * random.random(len(edges)))
    mass = 10 ** random.uniform(-0.5, 0.5, count)
    mass[0] = np.inf
    ks = 10 ** random.uniform(0, 3, len(edges))
    kd = np.zeros(len(edges)) if seed % 4 == 0 else 10 ** random.uniform(-2, 0.5, len(edges))
    scene = jeuler.Scene((jeuler.Springs(edges, ks=ks, kd=kd, rest_length=length),))
    return scene, jeuler.ParticleState(jnp.asarray(x), jnp.zeros(x.shape), jnp.asarray(mass))


def jacobian_of(scene, state):
    """The matrix of the linearised equation."""
    y, args = scene.as_equation(state)
    vector, split = jax.flatten_util.ravel_pytree(y)
    slope = lambda u: jax.flatten_util.ravel_pytree(scene.vector_field(0.0, split(u), args))[0]  # noqa: E731
    return jax.jacfwd(slope)(vector)


@functools.partial(jax.jit, static_argnames="step")
def image(step, jacobian, dt):
    """The matrix of one step on it."""
    half = len(jacobian) // 2

    def linear(t, y, args):
        slope = jacobian @ jnp.concatenate(y)
        return slope[:half], slope[half:]

    return jax.vmap(lambda u: jnp.concatenate(step(linear, 0.0, (u[:half], u[half:]), dt, None)), out_axes=1)(
        jnp.eye(2 * half)
    )


def grows(matrix):
    """Whether 2^40 steps grow more than a drift, whose norm doubles with the number of steps, by repeated squaring."""
    height, heights = 0.0, []
    for _ in range(40):
        size = np.linalg.norm(matrix)
        if not 0 < size < np.inf:
            return bool(size)
        heights.append(height + np.log(size))
        matrix, height = (matrix / size) @ (matrix / size), 2 * heights[-1]
    return heights[-1] - heights[-2] > np.log(3)


def by_runs(step, jacobian, fastest):
    """The dt from which on runs grow: 0.0 if they do at the least dt where growth shows in 2^40 steps, inf if never."""
    unstable = lambda dt: grows(np.asarray(image(step, jacobian, dt)))  # noqa: E731
    least = 1e-5 if step is jeuler.euler_step else 3e-3  # grows by (dt omega)^2 / 2 a step, or by (dt omega)^4 / 8
    dts = np.geomspace(least, 100.0, 121) / fastest
    first = next((k for k, dt in enumerate(dts) if unstable(dt)), None)
    if first is None:
        return np.inf
    if first == 0:
        return 0.0
    low, high = dts[first - 1], dts[first]
    for _ in range(12):
        middle = np.sqrt(low * high)
        low, high = (low, middle) if unstable(middle) else (middle, high)
    return low


def main(nets):
    jax.config.update("jax_enable_x64", True)
    right, all_of_them, worst = collections.Counter(), collections.Counter(), collections.Counter()
    for seed in range(nets):
        scene, state = net(seed)
        jacobian = jacobian_of(scene, state)
        fastest = np.abs(np.linalg.eigvals(np.asarray(jacobian))).max()
        for name, step in STEPS.items():
            said = jeuler.stability_limit(scene, state, step=step)
            found = by_runs(step, jacobian, fastest)
            if found == 0.0:
                same = said * fastest <= 3e-3
            else:
                same = said == found if np.isinf(found) else abs(said - found) <= 0.02 * found
            if found and not np.isinf(found):
                worst[name] = max(worst[name], abs(said / found - 1))
            right[name] += same or not said.known
            all_of_them[name] += 1
            if not same:
                print(f"net {seed}, {name}: {float(said):.5g}, by runs {found:.5g}", flush=True)
    for name in STEPS:
        print(f"{name:26s} {right[name]} of {all_of_them[name]} within 2 %, worst {worst[name]:.2%}")


if __name__ == "__main__":
    given = arguments(__doc__, nets=200)
    main(int(given.nets))
