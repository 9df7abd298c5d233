"""``identifiability``: what a recording would determine, before there is one."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jeuler._core import checks
from jeuler._core.arguments import says_what_to_write
from jeuler._core.component import result
from jeuler.fitting._tables import identifiability_text
from jeuler.fitting.blind import describe_blind
from jeuler.fitting.evaluate import residual_and_jacobian
from jeuler.fitting.observations import amplitude_of
from jeuler.fitting.prediction import compiled_positions
from jeuler.fitting.recorded import Recorded
from jeuler.fitting.sampling import fastest
from jeuler.fitting.uncertainty import directions
from jeuler.particles.scene import Scene
from jeuler.particles.state import ParticleState
from jeuler.steps.explicit import Step, rk4_step


@result
class Identifiability:
    """What a recording would determine.

    Attributes:
      stderr: the standard errors that its noise would leave, by name, of the structure of the parameters; inf where
        nothing would be determined.
      covariance: of the parameters in the order of ``jax.flatten_util.ravel_pytree``, within what would be determined.
      singular_values: of the Jacobian with its columns scaled to one, largest first; one near 0 is a combination of
        parameters that hardly changes the motion.
      undetermined: names of the parameters that would not be determined.
      blind: the combinations of them that do not change the motion, in words.
      sigma: the noise that was taken, m.
      message: in one sentence.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> scene = jeuler.Scene((jeuler.Springs([[0, 1]], ks=9.0, kd=0.5, rest_length=1.0),))
      >>> state = jeuler.ParticleState([[0.0], [1.5]], jnp.zeros((2, 1)), mass=[jnp.inf, 1.0])
      >>> asked = jeuler.identifiability(scene, state, jnp.linspace(0, 3, 31), sigma=1e-3)
      >>> asked.undetermined, 0 < float(asked.stderr["ks"]) < 0.1
      ((), True)
    """

    stderr: dict[str, Any]
    covariance: np.ndarray
    singular_values: np.ndarray
    undetermined: tuple[str, ...]
    blind: tuple[str, ...]
    sigma: float
    message: str

    __repr__ = identifiability_text


@says_what_to_write(dts="dt=...", noise="sigma=...", positions="times, when positions will be measured")
def identifiability(
    scene: Scene,
    state: ParticleState,
    times: Any,
    parameters: tuple[str, ...] = ("ks", "kd"),
    *,
    sigma: float | None = None,
    observed: Any = None,
    where: Callable[[Scene], Any] | None = None,
    dt: float | None = None,
    t0: float = 0.0,
    step: Step = rk4_step,
) -> Identifiability:
    """What positions measured at these times would determine of a scene's parameters, before there are any.

        C = sigma^2 (J^T J)^+,   J = d positions / d parameters at the scene's values

    Args:
      scene: forces and effects, with values near those that are expected.
      state: the state at t0.
      times: when positions will be measured, (time,), s.
      parameters: what will be free, as in `fit_springs`.
      sigma: the noise of a position, m; None takes a thousandth of the motion.
      observed: which particles will be seen, (particle,), booleans; None takes all that can move.
      where: a function of the scene that picks further arrays, as in `fit_springs`.
      dt: step of the run, s; None takes a twentieth of the fastest period of the springs, and no more than the time
        between two samples.
      t0: time of the state, s.
      step: the method, as in `solve`.
    Returns: `Identifiability`.
    Raises: ValueError, naming the argument, what was expected and what came.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> scene = jeuler.Scene((jeuler.Springs([[0, 1]], ks=9.0, kd=0.5, rest_length=1.0),))
      >>> state = jeuler.ParticleState([[0.0], [1.5]], jnp.zeros((2, 1)), mass=[jnp.inf, 1.0])
      >>> asked = jeuler.identifiability(scene, state, jnp.linspace(0, 3, 31), ("ks", "kd", "mass"))
      >>> asked.blind
      ('kd, ks and mass only as their ratios',)

    Source: G. A. F. Seber, C. J. Wild, Nonlinear Regression, 1989, sect. 3.4.
    """
    checks.kind("state", state, ParticleState)
    checks.kind("scene", scene, Scene)
    state.check()
    shape = state.position.shape
    seen = np.broadcast_to(np.isfinite(np.asarray(state.mass)), shape[:1]) if observed is None else np.asarray(observed)
    if seen.shape != shape[:1] or seen.dtype != bool:
        raise ValueError(
            f"observed must be booleans of shape {shape[:1]}, one a particle, got {seen.dtype}{seen.shape}"
        )
    times = checks.reals("times", times, "numbers of shape (time,), s")
    targets = np.where(seen[:, None], np.zeros((times.size, *shape)), np.nan)
    task = Recorded.of(
        scene,
        state,
        times,
        targets,
        dt=_step_size(scene, state, times, t0) if dt is None else dt,
        t0=t0,
        num_steps=None,
        step=step,
        names=parameters,
        where=where,
    )
    problem = task.problem(task.start, None, None, None, ())
    x = np.asarray(problem.x, float)
    both = jax.jit(lambda x, data: residual_and_jacobian(problem.residual, x, data))
    _, jacobian = (np.asarray(a, float) for a in both(x, problem.data))
    if not np.isfinite(jacobian).all():
        raise ValueError("the motion is not finite within these times; use a smaller dt or a stabler step")
    if sigma is None:
        motion = np.asarray(compiled_positions(task.prediction)(task.start, task.data), float)
        sigma = 1e-3 * amplitude_of(motion[:, seen])
    checks.positive("sigma", sigma, "m")
    return _judged(problem, x, jacobian, float(sigma))


def _step_size(scene: Scene, state: ParticleState, times: np.ndarray, t0: float) -> float:
    mass = np.broadcast_to(np.asarray(state.mass, float), state.position.shape[:1])
    gaps = np.diff(np.unique(np.append(times, t0)))
    longest = float(np.median(gaps)) if len(gaps) else 0.01
    rate = fastest(scene, mass)
    return min(longest, 2 * np.pi / rate / 20) if rate > 0 else longest


def _judged(problem: Any, x: np.ndarray, jacobian: np.ndarray, sigma: float) -> Identifiability:
    """Errors and blind directions of a Jacobian."""
    layout = problem.layout
    with np.errstate(all="ignore"):
        d = directions(jacobian, problem.precision)
        half = d.vectors * np.where(d.seen, 1 / np.where(d.seen, d.values, 1), 0) / d.norms[:, None]
        covariance = sigma**2 * half @ half.T
        is_blind = 1 - np.sum(np.where(d.seen, d.vectors, 0) ** 2, axis=1) > 1e-6
    blind = describe_blind(d.null(), x, layout.names(), np.asarray(problem.lower) >= 0)
    error = np.where(is_blind, np.inf, np.sqrt(np.diag(covariance)))
    weak = [n for n, e, v in zip(layout.names(), error, x, strict=True) if np.isfinite(e) and e > abs(v) > 0]
    words = [f"nothing would determine {', '.join(blind)}"] if blind else []
    words += [f"errors would be larger than the values of {', '.join(weak[:6])}"] if weak else []
    return Identifiability(
        stderr=layout.params(jnp.asarray(error)),
        covariance=covariance,
        singular_values=d.values,
        undetermined=tuple(n for n, out in zip(layout.names(), is_blind, strict=True) if out),
        blind=blind,
        sigma=sigma,
        message="; ".join(words) or f"all parameters would be determined, for noise of {sigma:.2g} m",
    )
