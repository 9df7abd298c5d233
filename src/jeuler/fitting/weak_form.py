"""Stiffness, damping and all that enters the forces linearly, from tracks alone: no guess, no run, no local minimum.

    integral of w'' m x  =  sum_k theta_k integral of w F_k(x, v)

is the equation of motion m x'' = sum_k theta_k F_k, multiplied by a bump w that is 0 with its slopes at both ends and
integrated by parts twice, so that no acceleration is taken from noisy positions. One sparse linear problem, with what
cannot be negative kept so.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jeuler.fitting.nonnegative import nonnegative_least_squares
from jeuler.fitting.parameters import Places, owners_of
from jeuler.fitting.smooth import Tracks, bumps, smoothed
from jeuler.forces.springs import Springs
from jeuler.particles.fields import declared
from jeuler.particles.scene import Scene
from jeuler.particles.state import ParticleState

HALF_WIDTHS = (30.0, 18.0, 11.0, 7.0, 4.5, 3.0)  # of the bumps, in samples
MOST_DENSE = 64  # numbers of a force that is differentiated as a whole


@dataclasses.dataclass(frozen=True)
class WeakForm:
    """What the weak form says.

    Attributes:
      params: the starting values with those that it determines put in.
      singular_values: of the scaled linear problem, largest first; None for more than 500 unknowns.
      residual: root mean square of what is left, over that of the accelerations.
    """

    params: dict[str, Any]
    singular_values: np.ndarray | None
    residual: float


class Rows:
    """The rows of the linear problem: one for each free particle, bump and component."""

    bump: Any
    second: Any
    tracks: Tracks
    mass: np.ndarray
    used: np.ndarray
    number: np.ndarray
    count: int

    def __init__(self, tracks: Tracks, mass: np.ndarray, edges: list[np.ndarray], half_width: float) -> None:
        self.bump, self.second, inside = bumps(tracks.times, half_width)  # sparse: a bump is short
        self.tracks, self.mass = tracks, mass
        unknown = inside @ (~tracks.known).astype(float) > 0  # (bump, particle)
        spoilt = unknown.copy()
        for pairs in edges:
            for a, b in (pairs.T, pairs.T[::-1]):
                np.logical_or.at(spoilt.T, a, unknown.T[b])
        self.used = (~spoilt & np.isfinite(mass)[None, :]).T  # (particle, bump)
        dim = tracks.position.shape[2]
        number = np.full((*self.used.shape, dim), -1)
        number[self.used] = np.arange(int(self.used.sum()) * dim).reshape(-1, dim)
        self.number = number
        self.count = int(self.used.sum()) * dim

    def of_particles(self, field: np.ndarray) -> np.ndarray:
        """The integrals of bump times a force (fine, particle, dim), over the mass, as rows."""
        return (_integrals(self.bump, field) / self.mass[:, None, None])[self.used].ravel()

    def acceleration(self) -> np.ndarray:
        """The integrals of the second derivative of the bumps times the position: the left-hand side."""
        return _integrals(self.second, self.tracks.position)[self.used].ravel()

    def of_springs(self, pairs: np.ndarray, on_first: np.ndarray) -> Any:
        """A sparse matrix (row, spring) from the force on the first end of each spring, (fine, spring, dim)."""
        from scipy.sparse import coo_matrix

        integral = _integrals(self.bump, on_first)
        rows, columns, values = [], [], []
        for end, sign in ((0, 1.0), (1, -1.0)):
            place = self.number[pairs[:, end]]  # (spring, bump, dim)
            value = sign * integral / np.where(np.isfinite(self.mass), self.mass, 1)[pairs[:, end], None, None]
            keep = place >= 0
            rows.append(place[keep])
            values.append(value[keep])
            columns.append(np.broadcast_to(np.arange(len(pairs))[:, None, None], place.shape)[keep])
        triple = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
        return coo_matrix(triple, shape=(self.count, len(pairs))).tocsc()


def _integrals(bump: Any, field: np.ndarray) -> np.ndarray:
    """The integrals of bumps times a field (fine, item, dim), (item, bump, dim)."""
    flat = bump @ np.ascontiguousarray(field.reshape(len(field), -1))
    return flat.reshape(-1, *field.shape[1:]).transpose(1, 0, 2)


def weak_form(
    scene: Scene, state: ParticleState, times: np.ndarray, targets: np.ndarray, places: Places, start: dict[str, Any]
) -> WeakForm | None:
    """The parameters from the tracks; None where these say nothing: too few samples, or nothing enters linearly."""
    if places.ties:
        untied = weak_form(scene, state, times, targets, places.untied, places.expanded(start))
        return None if untied is None else dataclasses.replace(untied, params=places.reduced(untied.params))
    tracks = smoothed(times, targets)
    if tracks is None or any(declared(force, "reads") for force in scene.forces):
        return None
    tracks = with_pinned(tracks, state, places)
    mass = np.broadcast_to(np.asarray(state.mass, float), tracks.known.shape[1:])
    best = None
    for samples in HALF_WIDTHS:
        half_width = samples * tracks.spacing
        if half_width > 0.25 * (tracks.times[-1] - tracks.times[0]):
            continue
        found = _solve(scene, tracks, mass, places, start, half_width)
        if found is not None and best is not None and found[0] > 2 * best[0]:
            break  # narrower ones see more of the noise
        if found is not None and (best is None or found[0] < best[0]):
            best = found
    if best is None:
        return None
    params = dict(best[1].params)
    params |= _initial(tracks, state, places, start, float(times[0]))
    return dataclasses.replace(best[1], params=params)


def with_pinned(tracks: Tracks, state: ParticleState, places: Places) -> Tracks:
    """The tracks with pinned particles that were not observed at their places."""
    position = np.asarray(state.position, float)
    for particle in places.pinned:
        if not tracks.known[:, particle].any():
            tracks.position[:, particle] = position[particle]
            tracks.velocity[:, particle] = 0
            tracks.known[:, particle] = True
    return tracks


def _initial(
    tracks: Tracks, state: ParticleState, places: Places, start: dict[str, Any], first: float
) -> dict[str, Any]:
    """Initial positions and velocities, where they are free and the tracks begin with the run."""
    rows = places.rows("position")
    known = tracks.known[0, rows][:, None]
    found = {}
    for name, track in (("position", tracks.position), ("velocity", tracks.velocity)):
        if name in start:
            found[name] = jnp.asarray(np.where(known, track[0, rows], start[name]), state.position.dtype)
    return found


def _solve(
    scene: Scene, tracks: Tracks, mass: np.ndarray, places: Places, start: dict[str, Any], half_width: float
) -> tuple[float, WeakForm] | None:
    """One linear problem, with bumps of one width: how well it determines its unknowns, and what it says."""
    from scipy.sparse import hstack

    springs = [(k, f) for k, f in enumerate(scene.forces) if isinstance(f, Springs)]
    rows = Rows(tracks, mass, [np.asarray(f.edges[:]) for _, f in springs], half_width)
    if not rows.count:
        return None
    right, columns, targets, positive = rows.acceleration(), [], [], []
    for k, force in enumerate(scene.forces):
        part = (
            _spring_terms(rows, force, k, scene, places) if isinstance(force, Springs) and not force.is_moving else None
        )
        part = _terms_of(rows, force, k, scene, places) if part is None else part
        right = right - part[0]
        for matrix, target, sign in part[1]:
            columns.append(matrix)
            targets.append(target)
            positive.append(np.full(matrix.shape[1], sign))
    if not columns:
        return None
    matrix = hstack(columns).tocsc()
    found, relative_error, values = nonnegative_least_squares(matrix, right, np.concatenate(positive))
    params = _gathered(scene, places, start, targets, [c.shape[1] for c in columns], found)
    left = matrix @ found - right
    size = float(np.sqrt(np.mean(right**2))) or 1.0
    return relative_error, WeakForm(params, values, float(np.sqrt(np.mean(left**2))) / size)


def _free_fields(scene: Scene, places: Places, owner: int) -> dict[str, str]:
    """The fields of one force that are fitted, with the name under which they are."""
    found = {}
    for name in places.names:
        owners, field = owners_of(scene, name)
        if owner in owners:
            found[field] = name
    return found


def _spring_terms(
    rows: Rows, force: Springs, k: int, scene: Scene, places: Places
) -> tuple[np.ndarray, list[Any]] | None:
    """What springs add that is known, and the columns of ks, kd and ks L."""
    free = _free_fields(scene, places, k)
    pairs = np.asarray(force.edges[:])
    if not len(pairs):
        return np.zeros(rows.count), []
    x, v = rows.tracks.position, rows.tracks.velocity
    d, dv = x[:, pairs[:, 0]] - x[:, pairs[:, 1]], v[:, pairs[:, 0]] - v[:, pairs[:, 1]]
    r = np.linalg.norm(d, axis=-1, keepdims=True)
    u = d / np.where(r > 0, r, 1)
    ks, kd, length = (
        np.broadcast_to(np.asarray(a, float), (len(pairs),)) for a in (force.ks, force.kd, force.rest_length)
    )
    known, terms = np.zeros(rows.count), []

    def add(field: str, unit: np.ndarray, value: np.ndarray) -> None:
        nonlocal known
        matrix = rows.of_springs(pairs, unit)
        if field in free or (field == "ks L" and "rest_length" in free and "ks" in free):
            shared = (
                _shared(force, field) if field != "ks L" else _shared(force, "ks") and _shared(force, "rest_length")
            )
            matrix = _summed(matrix) if shared else matrix
            terms.append((matrix, (k, field), True))
        else:
            known = known + matrix @ value

    if "rest_length" in free and "ks" in free:
        add("ks", -d, ks)
        add("ks L", u, ks * length)
    elif "rest_length" in free:  # ks known
        known = known + rows.of_springs(pairs, -d) @ ks
        matrix = rows.of_springs(pairs, u * ks[:, None])
        shared = _shared(force, "rest_length")
        terms.append((_summed(matrix) if shared else matrix, (k, "rest_length"), True))
    else:
        add("ks", (length[:, None] - r) * u, ks)
    add("kd", -np.sum(dv * u, axis=-1, keepdims=True) * u, kd)
    return known, terms


def _shared(force: Any, field: str) -> bool:
    """Whether one number serves all springs."""
    return not np.ndim(getattr(force, field))


def _summed(matrix: Any) -> Any:
    from scipy.sparse import csc_matrix

    return csc_matrix(matrix.sum(axis=1))


def _terms_of(rows: Rows, force: Any, k: int, scene: Scene, places: Places) -> tuple[np.ndarray, list[Any]]:
    """What any other force adds that is known, and the columns of those of its free numbers that enter linearly."""
    from scipy.sparse import csc_matrix

    free = _free_fields(scene, places, k)
    x, v, t = (jnp.asarray(a) for a in (rows.tracks.position, rows.tracks.velocity, rows.tracks.times))
    mass = jnp.asarray(rows.mass)
    names = list(free)
    values = [np.asarray(getattr(force, field), float) for field in names]
    sizes = [value.size for value in values]

    def at(theta: Any, t: Any, x: Any, v: Any) -> Any:
        from jeuler._core.component import replace

        split = np.cumsum([0, *sizes])
        fields = {n: theta[a:b].reshape(y.shape) for n, a, b, y in zip(names, split, split[1:], values, strict=False)}
        return (replace(force, **fields) if fields else force)(t, x, v, mass)

    everywhere = jax.jit(jax.vmap(at, in_axes=(None, 0, 0, 0)))
    theta = np.concatenate([y.ravel() for y in values]) if values else np.zeros(0)
    here = np.asarray(everywhere(jnp.asarray(theta), t, x, v), float)
    if not 0 < len(theta) <= MOST_DENSE:
        return rows.of_particles(here), []
    by_theta = jax.jit(jax.vmap(jax.jacfwd(at), in_axes=(None, 0, 0, 0)))
    slope = np.asarray(by_theta(jnp.asarray(theta), t, x, v), float)  # (fine, particle, dim, number)
    known, terms, start, moved = here.copy(), [], 0, theta
    for field, size in zip(names, sizes, strict=True):
        own = slice(start, start + size)
        tried = moved.copy()
        tried[own] = 2 * theta[own] + 1
        there = np.asarray(everywhere(jnp.asarray(tried), t, x, v), float)
        expected = here + slope @ (tried - theta)
        start += size
        if not np.allclose(there, expected, rtol=1e-4, atol=1e-4 * np.abs(expected).max(initial=0)):
            continue  # not affine, or not together with those before it: it stays at its start
        moved = tried
        known = known - slope[..., own] @ theta[own]
        columns = np.stack([rows.of_particles(slope[..., c]) for c in range(own.start, own.stop)], axis=1)
        positive = places.positive(scene)[free[field]]
        terms.append((csc_matrix(columns), (k, field), positive))
    return rows.of_particles(known), terms


def _gathered(
    scene: Scene, places: Places, start: dict[str, Any], targets: list[Any], sizes: list[int], found: np.ndarray
) -> dict[str, Any]:
    """The starting values with what was found in its places; what was not determined (NaN) stays."""
    parts = dict(zip(targets, np.split(found, np.cumsum(sizes)[:-1]), strict=True))
    params = dict(start)
    for name in places.names:
        owners, field = owners_of(scene, name)
        if not owners:
            continue
        values = start[name] if isinstance(start[name], tuple) else (start[name],)
        new = []
        for k, value in zip(owners, values, strict=True):
            given = np.asarray(value, float)
            part = parts.get((k, field))
            if field == "rest_length" and (k, "ks L") in parts:
                with np.errstate(all="ignore"):
                    part = parts[k, "ks L"] / parts[k, "ks"]
                    part = np.nanmedian(part, keepdims=True) if not given.ndim else part
            if part is not None:
                part = part.reshape(given.shape) if part.size == given.size else np.broadcast_to(part, given.shape)
                given = np.where(np.isfinite(part), part, given)
            new.append(jnp.asarray(given, jnp.asarray(value).dtype))
        params[name] = tuple(new) if isinstance(start[name], tuple) else new[0]
    return params
