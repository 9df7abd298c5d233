"""Hair that keeps its curl: bending about a smoothed strand, and core springs along it.

The stretch springs of a strand are ordinary `Springs` between neighbours (`strand_edges`).
"""

from __future__ import annotations

import functools
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jeuler._core import checks
from jeuler._core.annotations import Parameter, ParticleIndices
from jeuler._core.arguments import says_what_to_write
from jeuler._core.component import component, store_as_float
from jeuler._core.indices import Indices
from jeuler._core.limits import check_limits
from jeuler._core.vectors import direction


@says_what_to_write()
def strand_edges(strands: Any) -> np.ndarray:
    """The pairs of neighbours along strands: (strand, node) indices to (spring, 2), for `Springs`.

    Args:
      strands: particle indices along each strand from its root, integers (strand, node).
    Returns: the pairs, integers (strand x (node - 1), 2).
    Raises: ValueError, if strands is not an integer (strand, node) array.
    Example:
      >>> import jeuler
      >>> jeuler.strand_edges([[0, 1, 2], [3, 4, 5]]).tolist()
      [[0, 1], [1, 2], [3, 4], [4, 5]]
    """
    strands = checks.integers("strands", strands, "integers of shape (strand, node), particle indices")
    if strands.ndim != 2 or strands.shape[1] < 2:
        raise ValueError(
            f"strands must have shape (strand, node) with two nodes at least, got {strands.shape}; "
            f"for one strand write strand_edges([strand])"
        )
    return np.stack([strands[:, :-1], strands[:, 1:]], axis=-1).reshape(-1, 2)


def smoothed(edges: Array, share: Array) -> Array:
    """Edges of strands after a low-pass filter from the root on, (strand, edge, dim).

        d_i = 2 (1 - b) d_{i-1} - (1 - b)^2 d_{i-2} + b^2 e_i,   before the root d = e_0

    Its impulse response is b^2 (k + 1) (1 - b)^k, so it is one small triangular matrix; what is missing of each row's
    sum, 1, is what the edges before the root would have given.
    """
    n = edges.shape[1]
    behind = np.arange(n)[:, None] - np.arange(n)[None, :]
    k = jnp.asarray(np.maximum(behind, 0))
    weights = jnp.where(behind >= 0, share**2 * (k + 1) * (1 - share) ** k, 0).astype(edges.dtype)
    weights = weights.at[:, 0].add(1 - jnp.sum(weights, axis=1))
    return jnp.einsum("ij,sjd->sid", weights, edges)


def share_of(smoothing: Array, edges: Array) -> Array:
    """b = 1 - exp(-l / smoothing), for rest edges of mean length l."""
    length, _ = direction(edges)
    return 1 - jnp.exp(-jnp.mean(length) / smoothing)


def transported_frames(edges: Array) -> Array:
    """A frame at each edge of a curve, carried from the root without twist: (strand, edge, 3, 3), columns.

    Each frame is the one before, turned by the smallest rotation that takes the last direction to the next,
        R v = v + a x v + a x (a x v) / (1 + u.w),   a = u x w
    """
    _, unit = direction(edges)

    def root(u):
        seed = jnp.where(jnp.abs(u[2]) < 0.9, jnp.array([0.0, 0.0, 1.0]), jnp.array([1.0, 0.0, 0.0])).astype(u.dtype)
        _, first = direction(seed - jnp.dot(seed, u) * u)
        return jnp.stack([u, first, jnp.cross(u, first)])

    def turn(frame_and_u, w):
        frame, u = frame_and_u
        a = jnp.cross(u, w)[:, None, :]
        lean = jnp.maximum(1 + jnp.sum(u * w, axis=-1), 1e-3)[:, None, None]
        turned = frame + jnp.cross(a, frame) + jnp.cross(a, jnp.cross(a, frame)) / lean
        return (turned, w), turned

    first = jax.vmap(root)(unit[:, 0])
    _, rest = lax.scan(turn, (first, unit[:, 0]), jnp.moveaxis(unit[:, 1:], 1, 0))
    frames = jnp.concatenate([first[:, None], jnp.moveaxis(rest, 0, 1)], axis=1)
    return jnp.swapaxes(frames, -1, -2)


class _OnStrands:
    """What the forces on strands share: fields as arrays, their checks, and strands that die as a whole."""

    strands: Any
    rest_position: Array

    axes: ClassVar[dict[str, int]] = {"stiffness": 0, "damping": 0, "smoothing": 0}
    limits: ClassVar[dict[str, Any]] = {
        "rest_position": ("", "m"),
        "stiffness": (">= 0", "N/m"),
        "damping": (">= 0", "N s/m"),
        "smoothing": ("> 0", "m"),
    }

    def __post_init__(self) -> None:
        name = f"{type(self).__name__}.strands"
        object.__setattr__(self, "strands", Indices(self.strands, name, "integers of shape (strand, node)"))
        store_as_float(self, "rest_position", "stiffness", "damping", "smoothing")
        check_strands(type(self).__name__, self.strands, self.rest_position)
        check_limits(self)

    def prepare(self, context: Any) -> Any:
        """Only strands that live as a whole: a strand of which a node died has no bending and no core."""
        return self if context.alive is None else functools.partial(self.__call__, alive=context.alive)  # type: ignore[operator]

    def check(self, particles: int, dim: int) -> None:
        checks.indices(f"{type(self).__name__}.strands", self.strands, particles, "particle indices")
        if dim != 3:
            raise ValueError(f"{type(self).__name__} needs particles in space, dim 3, got dim {dim}")


@component(static=("strands",), positive=("stiffness", "damping", "smoothing"))
class StrandBending(_OnStrands):
    """Bending springs of curly hair: each edge is pulled to its rest direction in the frame of the smoothed strand.

        F on node i = k (e_i - t_i) + c (dv_i - (dv_i . u_i) u_i),   and the opposite on node i + 1
        t_i = T_{i-1} s_i,   s_i the rest edge in the rest frame T_{i-1}

    The frames T are carried without twist along a smoothed strand, so a small motion of one coil does not turn all
    below it.

    Args:
      strands: particle indices from root to tip, integers (strand, node), node >= 3. Static.
      rest_position: where they are at rest, (strand, node, 3), m. Differentiable.
      stiffness: k, (), N/m. Differentiable.
      damping: c, (), N s/m. Differentiable.
      smoothing: length over which the strand is smoothed, (), m, > 0; longer than a coil. Differentiable.
    Returns: called as a force ``(t, position, velocity, mass)``, the force on each particle, (particle, 3), N.
    Raises: ValueError, if the rest shape and the indices disagree; in `simulate`, if space is not of dim 3.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> hook = jnp.array([[[0.0, 0, 0], [0.0, 0, -1], [1.0, 0, -1]]])
      >>> bend = jeuler.StrandBending([[0, 1, 2]], hook, stiffness=1.0, damping=0.0, smoothing=2.0)
      >>> bool(jnp.abs(bend(0.0, hook[0], 0 * hook[0], jnp.asarray(1.0))).max() < 1e-6)
      True

    Source: H. Iben, M. Meyer, L. Petrovic, O. Soares, J. Anderson, A. Witkin, Artistic Simulation of Curly Hair, 2013,
      sect. 3.2.
    """

    strands: ParticleIndices
    rest_position: Parameter
    stiffness: Parameter
    damping: Parameter
    smoothing: Parameter

    def __call__(self, t: Any, position: Array, velocity: Array, mass: Array, *, alive: Array | None = None) -> Array:
        nodes = np.asarray(self.strands)
        rest = jnp.diff(self.rest_position, axis=1).astype(position.dtype)
        share = share_of(self.smoothing, rest)
        rest_frames = transported_frames(smoothed(rest, share))
        in_frame = jnp.einsum("seji,sej->sei", rest_frames[:, :-1], rest[:, 1:])

        e, dv = jnp.diff(position[nodes], axis=1), jnp.diff(velocity[nodes], axis=1)
        frames = transported_frames(smoothed(e, share))
        target = jnp.einsum("seij,sej->sei", frames[:, :-1], in_frame)
        _, u = direction(e[:, 1:])
        across = dv[:, 1:] - jnp.sum(dv[:, 1:] * u, axis=-1, keepdims=True) * u
        pull = self.stiffness * (e[:, 1:] - target) + self.damping * across
        return give_to_ends(pull.astype(position.dtype), alive, nodes, position)


@component(static=("strands",), positive=("stiffness", "damping", "smoothing"))
class StrandCore(_OnStrands):
    """Core springs of curly hair: they keep the coils from being pulled straight, yet let them sway.

        F on node i = k (|d_i| - |rest d_i|) u_i + c (w_i . u_i) u_i,   and the opposite on node i + 1

    with d the edges of the smoothed strand, u their directions and w their smoothed rates of change.

    Args:
      strands: particle indices from root to tip, integers (strand, node), node >= 3. Static.
      rest_position: where they are at rest, (strand, node, 3), m. Differentiable.
      stiffness: k, (), N/m. Differentiable.
      damping: c, (), N s/m. Differentiable.
      smoothing: length over which the strand is smoothed, (), m, > 0; longer than a coil. Differentiable.
    Returns: called as a force ``(t, position, velocity, mass)``, the force on each particle, (particle, 3), N.
    Raises: ValueError, if the rest shape and the indices disagree; in `simulate`, if space is not of dim 3.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> line = jnp.array([[[0.0, 0, 0], [0.0, 0, -1], [0.0, 0, -2]]])
      >>> core = jeuler.StrandCore([[0, 1, 2]], line, stiffness=1.0, damping=0.0, smoothing=1.0)
      >>> core(0.0, 2 * line[0], 0 * line[0], jnp.asarray(1.0)).tolist()
      [[0.0, 0.0, -1.0], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0]]

    Source: H. Iben, M. Meyer, L. Petrovic, O. Soares, J. Anderson, A. Witkin, Artistic Simulation of Curly Hair, 2013,
      sect. 3.3.
    """

    strands: ParticleIndices
    rest_position: Parameter
    stiffness: Parameter
    damping: Parameter
    smoothing: Parameter

    def __call__(self, t: Any, position: Array, velocity: Array, mass: Array, *, alive: Array | None = None) -> Array:
        nodes = np.asarray(self.strands)
        rest = jnp.diff(self.rest_position, axis=1).astype(position.dtype)
        share = share_of(self.smoothing, rest)
        rest_length, _ = direction(smoothed(rest, share))
        length, u = direction(smoothed(jnp.diff(position[nodes], axis=1), share))
        rate = smoothed(jnp.diff(velocity[nodes], axis=1), share)
        approach = jnp.sum(rate * u, axis=-1, keepdims=True)
        pull = (self.stiffness * (length - rest_length) + self.damping * approach) * u
        return give_to_ends(pull.astype(position.dtype), alive, nodes, position)


def give_to_ends(pull: Array, alive: Array | None, nodes: np.ndarray, position: Array) -> Array:
    """Each edge's pull, (strand, edge, 3), to its first node, and the opposite to its second: (particle, 3).

    The edges are the last of their strand of nodes, (strand, node); one of which a node is dead exerts no pull.
    """
    if alive is not None:
        pull = jnp.all(alive[nodes], axis=1).astype(pull.dtype)[:, None, None] * pull
    nodes = nodes[:, -pull.shape[1] - 1 :]
    ends = jnp.pad(pull, ((0, 0), (0, 1), (0, 0))) - jnp.pad(pull, ((0, 0), (1, 0), (0, 0)))
    return jnp.zeros_like(position).at[nodes.reshape(-1)].add(ends.reshape(-1, 3))


def check_strands(name: str, strands: Any, rest_position: Array) -> None:
    indices = np.asarray(strands)
    if indices.ndim != 2 or indices.shape[1] < 3:
        raise ValueError(
            f"{name}.strands must have shape (strand, node) with three nodes at least, got {indices.shape}"
        )
    checks.different(f"{name}.strands", indices, "particles")
    checks.shape(f"{name}.rest_position", rest_position.shape, (*indices.shape, 3))
