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
MOST_AT_ONCE = 500  # terms up to which the search begins with all pairs at once: nothing to go astray in
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


def select(normal: Normal, alpha: float, begin: list[int], kinds: bool = True) -> Selection:
    """Of four kinds of springs (with or without rest lengths, with or without damping) the one with the least BIC.

    The search goes on from the pairs of ``begin``, if there are any. Without ``kinds`` only the first is tried.
    """
    whole = _select(normal, (True, True, True), alpha, begin)
    if not kinds:
        return whole
    begin = whole.chosen.tolist()
    fewer = ((True, True, False), (True, False, True), (True, False, False))
    found = [*(_select(normal, terms, alpha, begin) for terms in fewer), whole]
    return min(found, key=lambda one: _information(one, found, normal.rows))


def selected(normal: Normal, terms: tuple[bool, bool, bool], chosen: list[int], alpha: float) -> Selection:
    """What the equations of motion say of springs that were chosen otherwise; those that they make negative are not."""
    use = np.flatnonzero(terms)
    limit = _threshold(alpha / max(normal.gram.shape[0] // len(TERMS), 1), len(use))
    fit = _Fit(normal, use, sorted(chosen))
    while len(fit.chosen) and (fit.x[:: len(use)] <= 0).any():
        fit = _Fit(normal, use, fit.chosen[fit.x[:: len(use)] > 0].tolist())
    return fit.selection(terms, limit)


def solved(normal: Normal, terms: tuple[bool, bool, bool]) -> np.ndarray:
    """The terms of all pairs, (pair, 3); 0 where a term is not used."""
    use, count = np.flatnonzero(terms), normal.gram.shape[0] // len(TERMS)
    values = np.zeros((count, len(TERMS)))
    values[:, use] = _Fit(normal, use, list(range(count))).x.reshape(count, len(use))
    return values


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
    chosen = _not_negative(normal, use, count) if small else list(begin)
    tried: set[tuple[int, ...]] = set()
    for turn in range(MOST_ROUNDS):
        if turn or not small:
            chosen = _forward(normal, use, chosen, limit, 0 if turn or begin else PATIENCE)
        fit = _Fit(normal, use, chosen)
        while (weak := fit.weak(limit)).any():
            fit = fit.without(weak)
        chosen = fit.chosen.tolist()
        key = tuple(sorted(chosen))
        if key in tried:
            break
        tried.add(key)
    return _Fit(normal, use, sorted(chosen)).selection(terms, limit)


def _terms_of(pairs: np.ndarray, each: int, use: np.ndarray) -> np.ndarray:
    """Indices of the terms ``use`` of these pairs, where each pair has so many."""
    return (each * pairs[:, None] + use).ravel()


def _not_negative(normal: Normal, use: np.ndarray, count: int) -> list[int]:
    """The pairs that non-negative least squares over all of them leaves in.

    That no term is negative often decides where the equations alone would not: of many springs that nearly balance each
    other, one would have to push.
    """
    from scipy.optimize import nnls

    index = _terms_of(np.arange(count), len(TERMS), use)
    gram = normal.gram[index][:, index].toarray()
    scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    values, vectors = np.linalg.eigh(gram / np.outer(scale, scale))
    keep = values > BLIND
    root = vectors[:, keep] * np.sqrt(values[keep])
    x, _ = nnls(
        root.T, (vectors[:, keep].T @ (normal.slope[index] / scale)) / np.sqrt(values[keep]), maxiter=20 * len(index)
    )
    return np.flatnonzero(x.reshape(count, -1)[:, 0] > 0).tolist()


def _forward(normal: Normal, use: np.ndarray, chosen: list[int], limit: float, patience: int) -> list[int]:
    """Add the pair that takes most off the sum of squares, until none takes enough, and go back to the best length.

    That has the least  -2 log likelihood + limit springs,  with a noise of what is left, no less than the known one.
    """
    rest, chosen = _Rest(normal, use), list(chosen)
    rest.take(chosen)
    best_length, least = len(chosen), np.inf
    while True:
        noise = rest.left / max(normal.rows - rest.used, 1)
        score = normal.rows * (np.log(noise) if noise > 1 else noise - 1) + limit * len(chosen)
        if score < least:
            best_length, least = len(chosen), score
        gain, estimate = _gains(rest.diagonal, rest.own, rest.slope)
        gain = np.where(rest.free & (estimate > 0), gain, -np.inf)
        best = int(np.argmax(gain))
        spent = len(chosen) > best_length + patience or rest.used + 2 * len(use) > normal.rows
        if spent or gain[best] <= limit * (1 if patience else max(noise, 1)):
            return chosen[:best_length]
        chosen.append(best)
        rest.take([best])


class _Rest:
    """What is left of the normal equations when the terms of some pairs are projected out.

    Attributes:
      slope: (pair, term).
      diagonal: the blocks of each pair, (pair, term, term); ``own`` before anything was taken.
      left: the sum of squares.
      used: how many terms were taken.
      free: which pairs were not, (pair,).
    """

    def __init__(self, normal: Normal, use: np.ndarray) -> None:
        size, count = len(use), normal.gram.shape[0] // len(TERMS)
        index = _terms_of(np.arange(count), len(TERMS), use)
        self.gram = normal.gram[index][:, index].tocsr()
        self.slope = normal.slope[index].reshape(count, size).copy()
        self.own = _diagonal_blocks(self.gram, count, size)
        self.diagonal = self.own.copy()
        self.left, self.used, self.free = normal.square, 0, np.ones(count, bool)
        # rows that are orthogonal to each other; pages that are not written to cost nothing
        self.basis = np.zeros((min(normal.rows, count * size), count * size))

    def take(self, pairs: list[int]) -> None:
        """Project the terms of these pairs out: at once, or one after the other where they are not independent."""
        if not pairs:
            return
        size = self.slope.shape[1]
        columns = _terms_of(np.asarray(pairs), size, np.arange(size))
        before = self.basis[: self.used]
        across = self.gram[columns].toarray() - before[:, columns].T @ before
        root = _root(across[:, columns], self.own[pairs])
        if root is None and len(pairs) > 1:
            for pair in pairs:
                self.take([pair])
            return
        if root is None:
            root = _inverse_root(self.diagonal[pairs[0]], self.own[pairs[0]])
        self._project(root @ across, root @ self.slope[pairs].ravel())
        self.free[pairs] = False

    def _project(self, new: np.ndarray, shift: np.ndarray) -> None:
        count, size = self.slope.shape
        self.basis[self.used : self.used + len(new)] = new
        each = new.reshape(-1, count, size)
        self.slope = self.slope - (shift @ new).reshape(count, size)
        self.diagonal = self.diagonal - np.einsum("kcs,kct->cst", each, each)
        self.left, self.used = self.left - float(shift @ shift), self.used + len(shift)


def _root(block: np.ndarray, own: np.ndarray) -> np.ndarray | None:
    """The inverse of the Cholesky factor; None where a pivot is no more than rounding of the pairs' own blocks."""
    scale = np.sqrt(np.maximum(np.einsum("css->cs", own).ravel(), 1e-300))
    try:
        factor = np.linalg.cholesky(block / np.outer(scale, scale))
    except np.linalg.LinAlgError:
        return None
    if np.diag(factor).min() ** 2 < BLIND:
        return None
    return np.linalg.inv(factor) / scale


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


def _inverse_root(block: np.ndarray, own: np.ndarray) -> np.ndarray:
    """W with W block W^T = 1 over what is not blind."""
    scale = np.sqrt(np.maximum(np.diag(own), 1e-300))
    values, vectors = np.linalg.eigh(block / np.outer(scale, scale))
    keep = values > BLIND
    return ((vectors / np.sqrt(np.where(keep, values, 1))).T / scale)[keep]


class _Fit:
    """Least squares over chosen pairs, with terms that must not be negative held at 0."""

    def __init__(self, normal: Normal, use: np.ndarray, chosen: list[int], inverse: np.ndarray | None = None) -> None:
        self.normal, self.use, self.chosen = normal, use, np.asarray(chosen, int)
        index = _terms_of(self.chosen, len(TERMS), use)
        self.gram = normal.gram[index][:, index].toarray()
        slope = normal.slope[index]
        self.scale = np.sqrt(np.maximum(np.diag(self.gram), 1e-300))
        gram, slope = self.gram / np.outer(self.scale, self.scale), slope / self.scale
        held = np.zeros(len(index), bool)
        is_ks = np.tile(use == 0, len(self.chosen))
        self.whole = _inverse(gram) if inverse is None else inverse
        free, inverse = np.arange(len(index)), self.whole
        while True:
            x = np.zeros(len(index))
            x[free] = slope[free] @ (_pseudo_inverse(gram[np.ix_(free, free)]) if inverse is None else inverse)
            wrong = ~held & ~is_ks & (x < 0)
            if not wrong.any():
                break
            inverse = None if inverse is None else _eliminated(inverse, wrong[free])
            held |= wrong
            free = np.flatnonzero(~held)
        self.free, self.x, self.index = free, x / self.scale, index
        self.inverse = _pseudo_inverse(gram[np.ix_(free, free)]) if inverse is None else inverse
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

    def without(self, weak: np.ndarray) -> _Fit:
        """The same without these pairs: their rows and columns of the inverse are eliminated, not inverted again."""
        rest = None if self.whole is None else _eliminated(self.whole, np.repeat(weak, len(self.use)))
        return _Fit(self.normal, self.use, self.chosen[~weak].tolist(), rest)

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
        index = _terms_of(np.arange(count), len(TERMS), self.use)
        gram = self.normal.gram[index][:, index].tocsr()
        across = gram[:, _terms_of(self.chosen, size, np.arange(size))[self.free]].toarray()
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


def _inverse(gram: np.ndarray) -> np.ndarray | None:
    """The inverse of a matrix with a unit diagonal; None where a pivot is no more than rounding."""
    from scipy.linalg import cho_factor, cho_solve

    if not len(gram):
        return gram
    try:
        factor = cho_factor(gram)
    except np.linalg.LinAlgError:
        return None
    if np.diag(factor[0]).min() ** 2 < BLIND:
        return None
    return cho_solve(factor, np.eye(len(gram)))


def _eliminated(inverse: np.ndarray, out: np.ndarray) -> np.ndarray:
    """The inverse of a matrix without these rows and columns, from its inverse."""
    kept = ~out
    across = inverse[np.ix_(kept, out)]
    return inverse[np.ix_(kept, kept)] - across @ np.linalg.solve(inverse[np.ix_(out, out)], across.T)


def _pseudo_inverse(gram: np.ndarray) -> np.ndarray:
    if not len(gram):
        return gram
    values, vectors = np.linalg.eigh(gram)
    keep = values > BLIND
    return (vectors[:, keep] / values[keep]) @ vectors[:, keep].T
