"""stability_limit of spring nets from 16 to 99,856 numbers in the state, against closed forms, and its seconds.

    python benchmarks/stability_sizes.py [side, all of 2 10 50 158] [step, all]

A square net of side^2 particles in the plane with one diagonal, masses drawn, at its rest lengths, one particle pinned;
kd = beta ks with beta 0 and 0.005 s. Then C = beta K, every mode is an oscillator of its own, and the limit is that of
the fastest: its frequency comes from scipy's Lanczos iteration on a matrix assembled here, the limit from the
polynomial of the step. What is found must be within 2 %, or say that it is not known.
"""

import math
import time
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize
import scipy.sparse
import scipy.sparse.linalg
from arguments import arguments
from stability_nets import STEPS

import jeuler

KS, BETAS, SIDES = 100.0, (0.0, 0.005), (2, 10, 50, 158)
DEGREE = {"euler": 1, "heun": 2, "rk4": 4, "extrapolated_euler(3)": 3, "extrapolated_euler(6)": 6}


def net(side, beta):
    """Scene, state, and the frequency of its fastest mode."""
    index = np.arange(side * side).reshape(side, side)
    pairs = (index[:-1], index[1:]), (index[:, :-1], index[:, 1:]), (index[:-1, :-1], index[1:, 1:])
    edges = np.concatenate([np.stack([a.ravel(), b.ravel()], 1) for a, b in pairs])
    x = np.stack(np.divmod(np.arange(side * side), side), 1).astype(float)
    along = x[edges[:, 0]] - x[edges[:, 1]]
    length = np.linalg.norm(along, axis=1)
    mass = 10 ** np.random.default_rng(0).uniform(-0.3, 0.3, side * side)
    mass[0] = np.inf
    scene = jeuler.Scene((jeuler.Springs(edges, ks=KS, kd=beta * KS, rest_length=length),))
    state = jeuler.ParticleState(jnp.asarray(x), jnp.zeros(x.shape), jnp.asarray(mass))
    spring = np.repeat(np.arange(len(edges)), 4)
    column = np.stack([2 * edges[:, 0], 2 * edges[:, 0] + 1, 2 * edges[:, 1], 2 * edges[:, 1] + 1], 1).ravel()
    unit = along / length[:, None]
    stretch = scipy.sparse.csr_matrix((np.concatenate([unit, -unit], 1).ravel(), (spring, column)))
    per_mass = scipy.sparse.diags(np.repeat(1 / np.sqrt(mass), 2))
    matrix = KS * per_mass @ stretch.T @ stretch @ per_mass
    fastest = np.linalg.eigvalsh(matrix.toarray())[-1] if side < 5 else scipy.sparse.linalg.eigsh(matrix, 1)[0][0]
    return scene, state, math.sqrt(fastest)


def closed_form(name, omega, beta):
    """The limit of the step on a mode of this frequency and damping beta omega^2."""
    if "implicit" in name:
        return math.inf
    if name == "symplectic_euler":
        return (math.sqrt(beta**2 * omega**4 + 4 * omega**2) - beta * omega**2) / omega**2
    mode = complex(-beta * omega**2 / 2, omega * math.sqrt(1 - (beta * omega / 2) ** 2))
    excess = lambda dt: abs(sum((dt * mode) ** k / math.factorial(k) for k in range(DEGREE[name] + 1))) - 1  # noqa: E731
    if beta == 0.0 and DEGREE[name] % 4 in (1, 2):
        return 0.0
    dts = np.linspace(1e-2, 6, 2000) / omega
    first = next(k for k, dt in enumerate(dts) if excess(dt) > 0)
    return scipy.optimize.brentq(excess, dts[first - 1] if first else 1e-9, dts[first])


def main(sides, names):
    jax.config.update("jax_enable_x64", True)
    warnings.simplefilter("ignore")
    wrong = 0
    for side in sides:
        for beta in BETAS:
            scene, state, omega = net(side, beta)
            for name in names:
                begun, cpu = time.perf_counter(), time.process_time()
                said = jeuler.stability_limit(scene, state, step=STEPS[name])
                seconds, cpu = time.perf_counter() - begun, time.process_time() - cpu
                true = closed_form(name, omega, beta)
                right = said == true if true in (0.0, math.inf) else abs(said / true - 1) <= 0.02
                wrong += not (right or not said.known)
                verdict = "right" if right else "WRONG" if said.known else f"off, and says: {said.reason}"
                print(
                    f"{4 * side**2:6d} numbers, beta {beta:g}, {name:24s} {float(said):9.5g} true {true:9.5g} "
                    f"{seconds:5.1f} s ({cpu:.1f} s of CPU), {'known' if said.known else 'not known'}, {verdict}",
                    flush=True,
                )
    print(f"{wrong} wrong without a word")


if __name__ == "__main__":
    given = arguments(__doc__, side="all", step="all")
    main(SIDES if given.side == "all" else [int(given.side)], STEPS if given.step == "all" else [given.step])
