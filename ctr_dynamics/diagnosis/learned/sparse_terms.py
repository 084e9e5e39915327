"""Sparse terms: which columns of a dictionary explain a residual, by Bayesian evidence.

In: a whitened residual, the columns of what is uncertain anyway and of the dictionary, and noise that is correlated. Out: the chosen columns
with their coefficients. These have one Gaussian prior whose width the evidence chooses, and so does it choose size and correlation time of
the noise. Before the data one term is expected, and every one is as likely as another: a larger dictionary makes each less likely, and no
threshold is needed (Scott and Berger 2010 on that correction).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Turn = Callable[[Floats], Floats]


@dataclass(frozen=True)
class Noise:
    """Correlated noise beside the white one of unit variance.

    Attributes:
        turn: takes whitened values (m, ...) to axes in which the noise is diagonal. variance: (m,) there, of unit size.
    """

    turn: Turn
    variance: Floats


@dataclass(frozen=True)
class Terms:
    """The chosen columns.

    Attributes:
        chosen: their numbers. values: of their coefficients. common: (f,) new departures of what is uncertain anyway.
    """

    chosen: tuple[int, ...]
    values: Floats
    common: Floats


@dataclass(frozen=True)
class Data:
    """A linear problem: residual (m,) without any term of the dictionary, columns (m, f) of what is uncertain with the present departure and variance
    (f,), and dictionary (m, d), whose coefficients are not negative where ``positive`` (d,)."""

    residual: Floats
    common: Floats
    departure: Floats
    variance: Floats
    dictionary: Floats
    positive: NDArray[np.bool_]


class _Turned:
    """A linear problem in the axes of one noise."""

    def __init__(self, data: Data, noise: Noise) -> None:
        target = data.residual + data.common @ data.departure
        self.prior, self.positive, self.variance = np.sqrt(data.variance), data.positive, noise.variance
        self.values = noise.turn(np.column_stack([data.common * self.prior, data.dictionary, target]))

    def reduced(self, size: float) -> _Reduced:
        """Normal equations with the noise of ``size``."""
        weight = 1.0 / (1.0 + size**2 * self.variance)
        products = self.values.T @ (weight[:, None] * self.values)
        return _Reduced(products, self.prior, self.positive, 0.5 * float(np.log(weight).sum()))


class _Reduced:
    """Normal equations of the dictionary under one noise, with all else eliminated.

    Args:
        products: (f + d + 1, f + d + 1) of what is uncertain anyway in its deviations ``prior`` (f,), of the dictionary and of the target.
        log_weight: log determinant of the noise's whitening.
    """

    def __init__(
        self, products: Floats, prior: Floats, positive: NDArray[np.bool_], log_weight: float
    ) -> None:
        f = len(prior)
        self.positive, self._prior = positive, prior
        self._factor = np.linalg.cholesky(np.eye(f) + products[:f, :f])
        self._half = np.linalg.solve(self._factor, products[:f, f:])
        left = products[f:, f:] - self._half.T @ self._half
        self.gram, self.right = left[:-1, :-1], left[:-1, -1]
        self.without = -0.5 * float(left[-1, -1]) - float(np.log(np.diag(self._factor)).sum()) + log_weight

    def solve(self, chosen: Sequence[int] | NDArray[np.int_], width: float) -> tuple[Floats, float]:
        """Coefficients and log evidence of the ``chosen``."""
        if len(chosen) == 0:
            return np.zeros(0), self.without
        at = np.asarray(chosen)
        information = np.eye(len(at)) + width**2 * self.gram[np.ix_(at, at)]
        factor = np.linalg.cholesky(information)
        half = np.linalg.solve(factor, width * self.right[at])
        values = width * (np.linalg.inv(factor).T @ half)
        evidence = self.without + 0.5 * float(half @ half) - float(np.log(np.diag(factor)).sum())
        return values, evidence

    def common(self, chosen: Sequence[int], values: Floats) -> Floats:
        """Departures (f,) of what is uncertain anyway beside ``values`` of the ``chosen``."""
        rest = self._half[:, -1] - self._half[:, list(chosen)] @ values
        return self._prior * np.linalg.solve(self._factor.T, rest)


def log_choice(count: int, of: int) -> float:
    """Log prior probability of a set of ``count`` columns ``of`` so many, of which one is expected."""
    return (of - count) * math.log1p(-1.0 / of) - count * math.log(of) if of > 1 else -math.log(2.0)


def _greedy(
    reduced: _Reduced, columns: NDArray[np.int_], width: float, patience: int
) -> tuple[list[int], float]:
    """Of ``columns`` (k,), added one by one, the best first, and taken away again where that gains; ``patience``: additions without gain."""
    total, positive = len(columns), reduced.positive[columns]
    S = np.eye(total) + width**2 * reduced.gram[np.ix_(columns, columns)]
    b = width * reduced.right[columns]
    fee = log_choice(1, total) - log_choice(0, total)
    trial: list[int] = []
    value = top = reduced.without + log_choice(0, total)
    best: list[int] = []
    waited = 0
    while waited <= patience and len(trial) < total:
        inverse = np.linalg.inv(S[np.ix_(trial, trial)])
        across = S[:, trial] @ inverse
        p = np.diag(S) - np.sum(across * S[:, trial], axis=1)
        q = b - across @ b[trial]
        gain = 0.5 * q**2 / np.maximum(p, 1.0) - 0.5 * np.log(np.maximum(p, 1.0)) + fee
        gain[trial] = -np.inf
        gain[positive & (q < 0.0)] = -np.inf
        if not np.isfinite(gain.max()):
            break
        trial.append(int(np.argmax(gain)))
        value += float(gain.max())
        while len(trial) > 1:
            inverse = np.linalg.inv(S[np.ix_(trial, trial)])
            mean, spread = inverse @ b[trial], np.diag(inverse)
            loss = (0.5 * mean**2 / spread + 0.5 * np.log(spread) + fee)[:-1]  # not the newest again
            wrong = (positive[trial] & (mean < 0.0))[:-1]
            if wrong.any():
                loss[~wrong] = np.inf
            elif loss.min() >= 0.0:
                break
            value -= float(loss.min())
            trial.pop(int(np.argmin(loss)))
        # anew, for sums of small changes of large numbers drift
        value = reduced.solve(columns[trial], width)[1] + log_choice(len(trial), total)
        waited += 1
        feasible = np.all(np.linalg.solve(S[np.ix_(trial, trial)], b[trial])[positive[trial]] >= 0.0)
        if feasible and value > top + 1e-9:
            best, top, waited = list(trial), value, 0
    return [int(k) for k in columns[best]], top


def choose_terms(
    data: Data,
    noises: Sequence[Noise],
    sizes: Floats,
    widths: Floats,
    *,
    alternatives: Sequence[NDArray[np.int_]] = (),
    patience: int = 2,
    rounds: int = 6,
) -> Terms:
    """Columns of the dictionary that the evidence asks for; none where it asks for none.

    Args:
        noises: correlation times to choose from. sizes: of the noise (0 for white noise alone). widths: of the prior.
        alternatives: (k,) columns each, all of one number, of which one is used; without them all columns are.
        patience: additions without a gain after which the search ends. rounds: between columns and noise, at most.
    """
    turned = [_Turned(data, noise) for noise in noises]
    reduced = {(i, j): t.reduced(s) for i, t in enumerate(turned) for j, s in enumerate(sizes)}
    every = list(alternatives) or [np.arange(data.dictionary.shape[1])]
    total = len(every[0])
    nothing = max(r.without for r in reduced.values()) + log_choice(0, total)
    start = max(reduced, key=lambda key: reduced[key].without)
    best: tuple[float, list[int], tuple[int, int], float] = (nothing, [], start, float(widths[0]))
    for columns in every:
        place, top = start, nothing
        for _ in range(rounds):
            found = [(*reversed(_greedy(reduced[place], columns, w, patience)), w) for w in widths]
            _, chosen, width = max(found, key=lambda item: item[0])
            place = max(reduced, key=lambda key: reduced[key].solve(chosen, width)[1])
            score = reduced[place].solve(chosen, width)[1] + log_choice(len(chosen), total)
            if score <= top + 1e-6:
                break
            top = score
            if score > best[0]:
                best = (score, chosen, place, float(width))
    _, chosen, place, width = best
    values = reduced[place].solve(chosen, width)[0]
    return Terms(tuple(chosen), values, reduced[place].common(chosen, values))
