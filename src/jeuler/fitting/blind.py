"""Directions of the parameters that the data do not see, put into words."""

from __future__ import annotations

import re

import numpy as np

SMALL = 1e-4  # a share of a direction below this is rounding
MOST = 4


def describe_blind(null: np.ndarray, x: np.ndarray, names: tuple[str, ...], relative: np.ndarray) -> tuple[str, ...]:
    """One phrase for each direction that changes nothing.

    Args:
      null: directions d params, (n, k).
      x: the parameters, (n,).
      names: of the parameters.
      relative: which of them are by nature positive, so that their relative change is what counts, (n,).
    """
    if not null.shape[1]:
        return ()
    sizes = np.where(relative & (x != 0), np.abs(x), 1.0)
    basis = _sparse_basis((null / sizes[:, None]).T)
    return tuple(_phrase(row, row * sizes, x, names, relative) for row in basis)


def _sparse_basis(rows: np.ndarray) -> np.ndarray:
    """The reduced row echelon form: directions of few parameters each."""
    rows = rows.copy()
    free = list(range(len(rows)))
    for _ in range(len(rows)):
        block = np.abs(rows[free])
        place, column = np.unravel_index(np.argmax(block), block.shape)
        pivot = free.pop(place)
        rows[pivot] /= rows[pivot, column]
        for other in range(len(rows)):
            if other != pivot:
                rows[other] -= rows[other, column] * rows[pivot]
    rows[np.abs(rows) < SMALL * np.abs(rows).max(axis=1, keepdims=True)] = 0
    order = np.argsort([np.flatnonzero(row)[0] for row in rows], kind="stable")
    return rows[order]


def _phrase(change: np.ndarray, step: np.ndarray, x: np.ndarray, names: tuple[str, ...], relative: np.ndarray) -> str:
    """A direction in words; ``change`` is by the size of each parameter, ``step`` in its unit."""
    where = np.flatnonzero(change)
    if len(where) == 1:
        return names[where[0]]
    words, s = _together([names[k] for k in where], names), step[where]
    same = len(where) == 2 and np.isclose(abs(s[0]), abs(s[1]), rtol=1e-2)
    # of two equal numbers of one array, sum and product are the same to first order: one unit, so it is a sum
    alike = same and _whole(names[where[0]]) == _whole(names[where[1]])
    if relative[where].all():
        c = change[where] * np.sign(x[where])
        if np.allclose(c, c[0], rtol=1e-2):
            return f"{words} {'only as their ratio' if len(where) == 2 else 'only as their ratios'}"
        if len(where) == 2 and np.isclose(c[0], -c[1], rtol=1e-2) and not alike:
            return f"{words} only as their product"
    if same:
        return f"{words} only as their {'difference' if s[0] * s[1] > 0 else 'sum'}"
    order = where[np.argsort(-np.abs(change[where]))][:MOST]
    terms = " ".join(f"{change[k]:+.2g} {names[k]}" for k in order)
    more = f" and {len(where) - MOST} more" if len(where) > MOST else ""
    return f"a combination ({terms}{more}{', each by its size' if relative[order].any() else ''})"


def _together(some: list[str], names: tuple[str, ...]) -> str:
    """The names as a list in words; an array of which all numbers take part by its own name."""
    found: dict[str, list[str]] = {}
    for name in some:
        found.setdefault(_whole(name), []).append(name)
    words: list[str] = []
    for whole, members in found.items():
        several = len(found) > 1 or len(members) > MOST  # else the numbers themselves say more
        complete = several and len(members) == sum(_whole(name) == whole for name in names)
        words += [whole] if complete else members
    if len(words) > MOST:
        words = [*words[:MOST], f"{len(words) - MOST} more"]
    return ", ".join(words[:-1]) + f" and {words[-1]}" if len(words) > 1 else words[0]


def _whole(name: str) -> str:
    """The array that a number belongs to: "ks" of "ks[3]"."""
    return re.sub(r"\[[\d, ]+\]$", "", name)
