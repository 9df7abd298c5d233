"""The point of a triangle that is nearest to another point."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array


def nearest_weights(p: Array, corners: Array) -> Array:
    """The weights (..., 3) of the corners (..., 3, 3) that make the point of the triangle nearest to p, (..., 3).

    The foot of the perpendicular where it is inside, else the nearest of the nearest points of the three sides. With
    derivatives, those of the side or of the inside where p is; a triangle without area is its sides.

    Source: C. Ericson, Real-Time Collision Detection, 2005, sect. 5.1.5.
    """
    a, b, c = jnp.moveaxis(corners, -2, 0)
    ab, ac, ap = b - a, c - a, p - a
    uu, uv, vv, pu, pv = (jnp.sum(x * y, axis=-1) for x, y in ((ab, ab), (ab, ac), (ac, ac), (ap, ab), (ap, ac)))
    area = uu * vv - uv * uv
    flat = area <= 16 * jnp.finfo(p.dtype).eps * uu * vv
    safe = jnp.where(flat, 1, area)
    v, w = (vv * pu - uv * pv) / safe, (uu * pv - uv * pu) / safe
    inside = jnp.stack([1 - v - w, v, w], axis=-1)
    is_inside = ~flat & jnp.all(inside >= 0, axis=-1)

    options, squares = [], []
    for k, (start, end) in enumerate(((a, b), (b, c), (c, a))):
        side = end - start
        square = jnp.sum(side * side, axis=-1)
        share = jnp.clip(jnp.sum((p - start) * side, axis=-1) / jnp.where(square > 0, square, 1), 0, 1)
        away = p - start - share[..., None] * side
        weights = [jnp.zeros_like(share)] * 3
        weights[k], weights[(k + 1) % 3] = 1 - share, share
        options.append(jnp.stack(weights, axis=-1))
        squares.append(jnp.sum(away * away, axis=-1))
    nearest = jnp.argmin(jnp.stack(squares, axis=-1), axis=-1)
    on_side = jnp.take_along_axis(jnp.stack(options, axis=-2), nearest[..., None, None], axis=-2)[..., 0, :]
    return jnp.where(is_inside[..., None], inside, on_side)
