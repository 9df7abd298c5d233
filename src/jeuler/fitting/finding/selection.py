"""Which candidates are springs: added while the data demand it, taken out where they do not.

A pair's terms are one group. A group is added if what it takes off the sum of squares, in units of the noise, exceeds
the chi-squared value that a pair without a spring exceeds with probability ``alpha / number of candidates``; after that
each group has to hold its place in the same way, given all the others. So the chance that noise alone puts one spring
too many into the whole net is about ``alpha``.

Source: S. Chen, S. A. Billings, W. Luo, Orthogonal least squares methods and their application to non-linear system
identification, 1989 (forward); Bonferroni's inequality.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from jeuler.fitting.finding.equations import TERMS, Normal

BLIND = 1e-9  # of a column's square: what is left of it beside the others when it is nothing but rounding
MOST_ROUNDS = 6
MOST_AT_ONCE = 500  # terms up to which the search begins with all pairs and only takes away: nothing to go astray in
FAINT = 1e-4  # of a usual spring: what is softer is not told from the error of the integrals in exact data
PATIENCE = 80  # pairs that are added beyond the best so far: many equal springs each take off only little at first


@dataclasses.dataclass(frozen=True)
class Selection:
    """What was selected.

    Attributes:
      terms: which of the three terms are used: ks, ks L, kd.
      chosen: indices of the pairs, (spring,).
      values: of the terms of each chosen pair, (spring, 3); 0 where a term is not used.
      covariance: of the used terms of the chosen pairs, in units of the noise, (n, n); ``active`` names them.
      active: indices of these terms among all, (n,).
      left: the sum of squares that is left, in units of the noise.
      surplus: the share by which errors are to be larger, as more than the noise is left; at least 1.
      statistic: what each chosen pair takes off the sum of squares, given the others, over surplus^2, (spring,).
      least_seen: the smallest ks with which each candidate would have been found with a chance of 95 %, (pair,), N/m.
    """

    terms: tuple[bool, bool, bool]
    chosen: np.ndarray
    values: np.ndarray
    covariance: np.ndarray
    active: np.ndarray
    left: float
    surplus: float
    statistic: np.ndarray
    least_seen: np.ndarray


def select(normal: Normal, alpha: float, begin: list[int]) -> Selection:
    """Of four kinds of springs (with or without rest lengths, with or without damping) the one with the least BIC.

    The search goes on from the pairs of ``begin``, if there are any.
    """
    whole = _select(normal, (True, True, True), alpha, begin)
    begin = whole.chosen.tolist()
    fewer = ((True, True, False), (True, False, True), (True, False, False))
    found = [*(_select(normal, terms, alpha, begin) for terms in fewer), whole]
    return min(found, key=lambda one: _information(one, found, normal.rows))


def _information(one: Selection, found: list[Selection], rows: int) -> float:
    """Bayes' information criterion, in units of the noise that the best of them leaves."""
    surplus = min(other.surplus for other in found)
    return one.left / surplus**2 + len(one.active) * np.log(max(rows, 2))


def _threshold(alpha: float, dof: int) -> float:
    from scipy.stats import chi2

    return float(chi2.isf(alpha, dof))


def _select(normal: Normal, terms: tuple[bool, bool, bool], alpha: float, begin: list[int]) -> Selection:
    use = np.flatnonzero(terms)
    count = normal.gram.shape[0] // len(TERMS)
    limit = _threshold(alpha / max(count, 1), len(use))
    small = len(use) * count <= min(MOST_AT_ONCE, normal.rows / 2)
    chosen = list(range(count)) if small else list(begin)
    tried: set[tuple[int, ...]] = set()
    for turn in range(MOST_ROUNDS):
        if turn or not small:
            chosen = _forward(normal, use, chosen, limit, 0 if turn or begin else PATIENCE)
        fit = _Fit(normal, use, chosen)
        while (weak := fit.weak(limit)).any():
            chosen = np.asarray(chosen)[~weak].tolist()
            fit = _Fit(normal, use, chosen)
        key = tuple(sorted(chosen))
        if key in tried:
            break
        tried.add(key)
    return _Fit(normal, use, sorted(chosen)).selection(terms, limit)


def _forward(normal: Normal, use: np.ndarray, chosen: list[int], limit: float, patience: int) -> list[int]:
    """Add the pair that takes most off the sum of squares, until none takes enough, and go back to the best length.

    That has the least  -2 log likelihood + limit springs,  with a noise of what is left, no less than the known one.
    """
    size = len(use)
    count = normal.gram.shape[0] // len(TERMS)
    index = (len(TERMS) * np.arange(count)[:, None] + use).ravel()
    gram = normal.gram[index][:, index].tocsr()
    slope = normal.slope[index].reshape(count, size).copy()
    diagonal = _diagonal_blocks(gram, count, size)
    own = diagonal.copy()
    left, rows = normal.square, normal.rows
    basis = np.zeros((min(rows, count * size), count * size))  # pages that are not written to cost nothing
    free = np.ones(count, bool)
    chosen, waiting, used = list(chosen), list(chosen), 0
    best_length, least = len(chosen), np.inf
    while True:
        if not waiting:
            noise = left / max(rows - used, 1)
            score = rows * (np.log(noise) if noise > 1 else noise - 1) + limit * len(chosen)
            if score < least:
                best_length, least = len(chosen), score
            gain, estimate = _gains(diagonal, own, slope)
            gain = np.where(free & (estimate > 0), gain, -np.inf)
            best = int(np.argmax(gain))
            spent = len(chosen) > best_length + patience or used + 2 * size > rows
            if spent or gain[best] <= limit * (1 if patience else max(noise, 1)):
                return chosen[:best_length]
            chosen.append(best)
        else:
            best = waiting.pop(0)
        free[best] = False
        columns = slice(best * size, (best + 1) * size)
        root, keep = _inverse_root(diagonal[best], own[best])
        before = basis[:used]
        new = root[keep] @ (gram[columns].toarray() - before[:, columns].T @ before)
        shift = root[keep] @ slope[best]
        basis[used : used + len(new)] = new
        each = new.reshape(-1, count, size)
        slope = slope - np.einsum("k,kcs->cs", shift, each)
        diagonal = diagonal - np.einsum("kcs,kct->cst", each, each)
        left, used = left - float(shift @ shift), used + len(shift)


def _diagonal_blocks(gram, count: int, size: int) -> np.ndarray:
    """(pair, term, term)."""
    block = np.zeros((count, size, size))
    for a in range(size):
        for b in range(size):
            shifted = gram.diagonal(b - a)
            block[:, a, b] = shifted[np.arange(count) * size + min(a, b)]
    return block


def _gains(diagonal: np.ndarray, own: np.ndarray, slope: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What each pair would take off the sum of squares, and the ks that it would have."""
    scale = np.sqrt(np.maximum(np.einsum("css->cs", own), 1e-300))
    matrix = diagonal / (scale[:, :, None] * scale[:, None, :])
    values, vectors = np.linalg.eigh(matrix)
    seen = values > BLIND
    rotated = np.einsum("cst,cs->ct", vectors, slope / scale)
    inverse = np.where(seen, 1 / np.where(seen, values, 1), 0)
    gain = np.sum(inverse * rotated**2, axis=1)
    estimate = np.einsum("cst,ct->cs", vectors, inverse * rotated) / scale
    return gain, estimate[:, 0]


def _inverse_root(block: np.ndarray, own: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """W with W block W^T = 1 over what is not blind, and which rows these are."""
    scale = np.sqrt(np.maximum(np.diag(own), 1e-300))
    values, vectors = np.linalg.eigh(block / np.outer(scale, scale))
    keep = values > BLIND
    return (vectors / np.sqrt(np.where(keep, values, 1))).T / scale, keep


class _Fit:
    """Least squares over chosen pairs, with terms that must not be negative held at 0."""

    def __init__(self, normal: Normal, use: np.ndarray, chosen: list[int]) -> None:
        self.normal, self.use, self.chosen = normal, use, np.asarray(chosen, int)
        index = (len(TERMS) * self.chosen[:, None] + use).ravel()
        self.gram = normal.gram[index][:, index].toarray()
        slope = normal.slope[index]
        self.scale = np.sqrt(np.maximum(np.diag(self.gram), 1e-300))
        gram, slope = self.gram / np.outer(self.scale, self.scale), slope / self.scale
        held = np.zeros(len(index), bool)
        is_ks = np.tile(use == 0, len(self.chosen))
        while True:
            free = np.flatnonzero(~held)
            x = np.zeros(len(index))
            x[free] = _solved(gram[np.ix_(free, free)], slope[free])
            wrong = ~held & ~is_ks & (x < 0)
            if not wrong.any():
                break
            held |= wrong
        self.free, self.x, self.index = free, x / self.scale, index
        self.inverse = _inverse(gram[np.ix_(free, free)])
        self.left = float(normal.square - x @ slope)
        freedom = max(normal.rows - len(free), 1)
        self.surplus = float(np.sqrt(max(1.0, self.left / freedom)))
        self.statistic = self._statistics(x)

    def _statistics(self, scaled: np.ndarray) -> np.ndarray:
        """What each pair takes off the sum of squares given the others; 0 where its ks is not positive."""
        size, count = len(self.use), len(self.chosen)
        place = np.full(count * size, -1)
        place[self.free] = np.arange(len(self.free))
        at = place.reshape(count, size)
        block = self.inverse[at[:, :, None], at[:, None, :]] if len(self.free) else np.zeros((0, size, size))
        used = at >= 0
        block = np.where(used[:, :, None] & used[:, None, :], block, np.eye(size))
        x = np.where(used, scaled.reshape(count, size), 0)
        taken = np.einsum("cs,cst,ct->c", x, np.linalg.pinv(block, rcond=1e-10, hermitian=True), x)
        return np.where(x[:, 0] > 0, taken, 0)

    def weak(self, limit: float) -> np.ndarray:
        """The worst third of those that do not hold their place."""
        ks = self.x[:: len(self.use)]
        faint = ks < FAINT * np.median(ks[ks > 0]) if (ks > 0).any() else ks <= 0
        below = np.flatnonzero(faint | (self.statistic <= limit * self.surplus**2))
        worst = below[np.argsort(self.statistic[below])][: -(-len(below) // 3)]
        return np.isin(np.arange(len(self.chosen)), worst)

    def selection(self, terms: tuple[bool, bool, bool], limit: float) -> Selection:
        values = np.zeros((len(self.chosen), len(TERMS)))
        values[:, self.use] = self.x.reshape(len(self.chosen), len(self.use))
        scale = self.scale[self.free]
        covariance = self.surplus**2 * self.inverse / np.outer(scale, scale)
        return Selection(
            terms,
            self.chosen,
            values,
            covariance,
            self.index[self.free],
            self.left,
            self.surplus,
            self.statistic / self.surplus**2,
            self._least_seen(limit),
        )

    def _least_seen(self, limit: float) -> np.ndarray:
        """(root of the limit + 1.645) standard errors of ks, each candidate added to what was chosen."""
        count, size = self.normal.gram.shape[0] // len(TERMS), len(self.use)
        index = (len(TERMS) * np.arange(count)[:, None] + self.use).ravel()
        gram = self.normal.gram[index][:, index].tocsr()
        across = gram[:, (size * self.chosen[:, None] + np.arange(size)).ravel()[self.free]].toarray()
        own = _diagonal_blocks(gram, count, size)
        values, vectors = np.linalg.eigh(self.inverse) if len(self.free) else (np.zeros(0), np.zeros((0, 0)))
        root = (vectors * np.sqrt(np.maximum(values, 0))).T / self.scale[self.free]
        part = (across @ root.T).reshape(count, size, -1)
        block = own - np.einsum("csk,ctk->cst", part, part)
        scale = np.sqrt(np.maximum(np.einsum("css->cs", own), 1e-300))
        block = block / (scale[:, :, None] * scale[:, None, :])
        values, vectors = np.linalg.eigh(block)
        with np.errstate(divide="ignore"):
            variance = np.sum(vectors[:, 0, :] ** 2 / np.maximum(values, 1e-300), axis=1)
        blind = values[:, 0] < BLIND
        error = np.sqrt(variance) / scale[:, 0] * self.surplus
        return np.where(blind & (vectors[:, 0, 0] ** 2 > 1e-6), np.inf, (np.sqrt(limit) + 1.645) * error)


def _factor(gram: np.ndarray) -> tuple[np.ndarray, bool]:
    """The Cholesky factor of a matrix with a unit diagonal; LinAlgError where a pivot is no more than rounding."""
    from scipy.linalg import cho_factor

    factor = cho_factor(gram)
    if len(gram) and np.diag(factor[0]).min() ** 2 < BLIND:
        raise np.linalg.LinAlgError("singular")
    return factor


def _solved(gram: np.ndarray, slope: np.ndarray) -> np.ndarray:
    from scipy.linalg import cho_solve

    if not len(gram):
        return slope
    try:
        return cho_solve(_factor(gram), slope)
    except np.linalg.LinAlgError:
        return _inverse(gram) @ slope


def _inverse(gram: np.ndarray) -> np.ndarray:
    """The inverse, or the pseudo-inverse where the matrix has none to speak of."""
    if not len(gram):
        return gram
    from scipy.linalg import cho_solve

    try:
        return cho_solve(_factor(gram), np.eye(len(gram)))
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(gram)
        keep = values > BLIND
        return (vectors[:, keep] / values[keep]) @ vectors[:, keep].T
