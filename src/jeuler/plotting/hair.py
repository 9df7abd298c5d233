"""Hair for pictures: many strands grown from few guides, as smooth curves, with their own light."""

from __future__ import annotations

from typing import Any

import numpy as np

from jeuler._core.component import result
from jeuler.plotting.light import light_through


@result
class Hair:
    """Strands that are drawn around simulated guides.

    Each strand belongs to the guide whose root is nearest to its own: it is that guide, moved by the difference of the
    roots, which shrinks to ``clump`` of it at the tip, so that strands gather to locks.

    Args:
      guides: particle indices from root to tip, integers (guide, node).
      nearest: of each strand its guide, integers (strand,).
      offset: of each strand its root from that of its guide, (strand, 3), m.
      clump: the share of the offset that is left at the tip.
      points: of the curve between two nodes.
    Example:
      >>> import numpy as np
      >>> from jeuler.plotting import Hair
      >>> guide = np.array([[[0.0, 0.0, 1.0], [0.0, 0.0, 1.1], [0.1, 0.0, 1.1]]])
      >>> hair = Hair.grown([[0, 1, 2]], guide, strands=50, spread=0.02)
      >>> hair.curves(guide[0]).shape  # 4 points between two nodes
      (50, 9, 3)
    """

    guides: np.ndarray
    nearest: np.ndarray
    offset: np.ndarray
    clump: float = 0.5
    points: int = 4

    @classmethod
    def grown(cls, guides: Any, at_rest: np.ndarray, strands: int, spread: float, seed: int = 0) -> Hair:
        """So many strands about guides at rest, (guide, node, 3), their roots within ``spread`` of a guide's, m."""
        random, roots = np.random.default_rng(seed), at_rest[:, 0]
        nearest = np.arange(strands) % len(roots)
        around = random.normal(0, spread, (strands, 3))
        outward = roots[nearest] / np.linalg.norm(roots[nearest], axis=1, keepdims=True)
        moved = roots[nearest] + around - np.sum(around * outward, axis=1, keepdims=True) * outward
        radius = np.linalg.norm(roots[nearest], axis=1, keepdims=True)
        on_head = moved / np.linalg.norm(moved, axis=1, keepdims=True) * radius
        return cls(np.asarray(guides), nearest, on_head - roots[nearest])

    def curves(self, position: np.ndarray) -> np.ndarray:
        """The strands through their nodes, (strand, point, 3), m."""
        guides = splines(position[self.guides], self.points)
        along = np.linspace(0, 1, guides.shape[1])[:, None]
        share = self.clump + (1 - self.clump) * (1 - along) ** 1.5
        return guides[self.nearest] + share * self.offset[:, None]

    def lit(
        self, position: np.ndarray, rgba: np.ndarray, sun: np.ndarray, toward: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Curves (strand, point, 3) and their colours (strand, point, 4)."""
        curves = self.curves(position)
        tint = rgba[self.guides[self.nearest, 0], :3][:, None]
        vary = np.random.default_rng(3).uniform(0.75, 1.2, (len(curves), 1, 1))
        flat = curves.reshape(-1, 3)
        length = np.linalg.norm(np.diff(curves, axis=1), axis=2).mean()
        light = light_through(flat, np.full(len(flat), 0.0007 * length), sun, 0.02).reshape(curves.shape[:2])
        rgb = sheen(curves, tint * vary, light, sun, toward)
        return curves, np.concatenate([rgb, np.ones_like(rgb[..., :1])], axis=-1)


def splines(nodes: np.ndarray, points: int) -> np.ndarray:
    """Smooth curves through nodes (curve, node, 3), so many points a piece: Catmull-Rom, (curve, point, 3)."""
    p = np.concatenate([2 * nodes[:, :1] - nodes[:, 1:2], nodes, 2 * nodes[:, -1:] - nodes[:, -2:-1]], axis=1)
    a, b, c, d = (p[:, k : k + nodes.shape[1] - 1, None] for k in range(4))
    u = np.linspace(0, 1, points, endpoint=False)[:, None]
    pieces = b + u / 2 * (c - a) + u**2 * (a - 2.5 * b + 2 * c - d / 2) + u**3 * (1.5 * (b - c) + (d - a) / 2)
    return np.concatenate([pieces.reshape(len(nodes), -1, 3), nodes[:, -1:]], axis=1)


def sheen(curves: np.ndarray, tint: np.ndarray, light: np.ndarray, sun: np.ndarray, toward: np.ndarray) -> np.ndarray:
    """Colours of hair (strand, point, 3): bright where the light runs across it, with two highlights along it.

    Source: J. T. Kajiya, T. L. Kay, Rendering Fur with Three Dimensional Textures, SIGGRAPH 1989.
    """
    along = np.gradient(curves, axis=1)
    along = along / np.maximum(np.linalg.norm(along, axis=-1, keepdims=True), 1e-12)
    half = (sun + toward) / np.linalg.norm(sun + toward)

    def across(direction: np.ndarray) -> np.ndarray:
        return np.sqrt(np.clip(1 - (along @ direction) ** 2, 0, 1))[..., None]

    light = light[..., None]
    soft = (0.18 + 0.25 * light) * across(toward) + 0.75 * light * across(sun)
    tinted = 0.55 * light * across(half + 0.1 * toward) ** 30
    white = 0.35 * light * across(half) ** 160
    return np.clip(tint * (soft + 2.0 * tinted) + white, 0, 1)
