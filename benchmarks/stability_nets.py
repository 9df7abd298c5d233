"""stability_limit on random spring nets against a bisection by long runs of each step.

    python benchmarks/stability_nets.py [nets, 200] [first, 0]

Nets of 3 to 10 particles in two and three dimensions; masses, ks and kd drawn, kd 0 in one net of four; rest lengths up
to 5 % short; the first particle pinned. The run is that of the step itself on the linearised equation, 2^42 steps by
repeated squaring of its matrix, for many dt at once; it grows where its norm grows more from 2^41 to 2^42 steps than
that of a drift, which doubles: by 5e-13 a step, and by more than roundoff of the matrix, 64 eps (1 + (dt omega)^2). A
limit that says that it is known is right within 2 % of the dt at which growth begins; one that says that it is not, or
that growth is too slow to show, must hold that dt between its lower and its upper bound.
"""

import collections
import functools
import warnings

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
    "extrapolated_euler(6)": jeuler.extrapolated_euler(6),
    "implicit_euler": jeuler.implicit_euler_step,
    "linearly_implicit_euler": jeuler.linearly_implicit_euler_step,
    "implicit_midpoint": jeuler.implicit_midpoint_step,
}
LARGEST = 30  # numbers in the position of the largest net


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


def padded(jacobian):
    """In a system of the size of the largest net, whose other particles stand still."""
    half = len(jacobian) // 2
    place = np.r_[:half, LARGEST : LARGEST + half]
    whole = np.zeros((2 * LARGEST, 2 * LARGEST))
    whole[np.ix_(place, place)] = jacobian
    return whole


@functools.partial(jax.jit, static_argnames="step")
def grows(step, jacobian, dts, fastest):
    """Whether runs of 2^42 steps grow more at the end than a drift and than roundoff makes them, at each dt."""

    def linear(t, y, args):
        slope = jacobian @ jnp.concatenate(y)
        return slope[:LARGEST], slope[LARGEST:]

    def image(dt):
        return jax.vmap(lambda u: jnp.concatenate(step(linear, 0.0, (u[:LARGEST], u[LARGEST:]), dt, None)), out_axes=1)(
            jnp.eye(2 * LARGEST)
        )

    def square(carry, _):
        matrix, height = carry
        size = jnp.linalg.norm(matrix)
        matrix, height = matrix / size, height + jnp.log(size)
        return (matrix @ matrix, 2 * height), height

    def of_one(dt):
        _, heights = jax.lax.scan(square, (image(dt), 0.0), None, length=43)
        roundoff = 64 * jnp.finfo(float).eps * (1 + (dt * fastest) ** 2)
        return ~(heights[-1] - heights[-2] <= jnp.maximum(jnp.log(3), roundoff * 2.0**41))

    return jax.lax.map(of_one, dts, batch_size=8)


def by_runs(step, jacobian, fastest):
    """The dt from which on runs grow: 0.0 if they do at dt omega = 1e-6, inf if never up to 100."""
    dts = np.geomspace(1e-6, 100.0, 96) / fastest
    low, high = 0.0, np.inf
    for refinement in range(4):
        unstable = np.asarray(grows(step, jacobian, jnp.asarray(dts), fastest))
        if not unstable.any():
            return high
        first = int(unstable.argmax())
        if first == 0 and refinement == 0:
            return 0.0
        high = dts[first]
        low = dts[first - 1] if first else low
        if high / low < 1.002:
            break
        dts = np.geomspace(low, high, 10)[1:]
    return high


def agrees(said, found, fastest):
    """Whether the answer is right within 2 %, or holds what was found between its bounds and says so."""
    if not said.known:
        return said.lower <= 1.02 * found and found <= 1.03 * said.upper
    if said == 0.0:
        return found * fastest <= 1e-4
    return said == found if np.isinf(found) else abs(said - found) <= 0.02 * found


def main(nets, first):
    jax.config.update("jax_enable_x64", True)
    warnings.simplefilter("ignore")
    right, known, all_of_them, worst = (collections.Counter() for _ in range(4))
    for seed in range(first, first + nets):
        scene, state = net(seed)
        jacobian = jacobian_of(scene, state)
        fastest = np.abs(np.linalg.eigvals(np.asarray(jacobian))).max()
        for name, step in STEPS.items():
            said = jeuler.stability_limit(scene, state, step=step)
            found = by_runs(step, padded(jacobian), fastest)
            same = agrees(said, found, fastest)
            if said.known and said and found < np.inf:
                worst[name] = max(worst[name], abs(said / found - 1))
            right[name] += same
            known[name] += said.known
            all_of_them[name] += 1
            if not same:
                bounds = f"{said.lower:.5g} to {said.upper:.5g}, {said.reason}"
                print(f"net {seed}, {name}: {float(said):.5g} ({bounds}), by runs {found:.5g}", flush=True)
    for name in STEPS:
        count = f"{right[name]} of {all_of_them[name]} right"
        print(f"{name:26s} {count}, {known[name]} known within 2 %, of these the worst {worst[name]:.2%}")


if __name__ == "__main__":
    given = arguments(__doc__, nets=200, first=0)
    main(int(given.nets), int(given.first))
