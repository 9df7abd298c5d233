"""The fewest steps that meet a target where errors are uneven, as where f jumps: by runs of many numbers of steps."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable

import numpy as np

from jeuler.accuracy.patience import Patience
from jeuler.accuracy.search import AIM, FACTOR, MARGIN, Search

EDGE = 0.008  # part of the number of steps to which the edge of stability is found
BESIDE = 0.97, 0.985, 1.015, 1.03  # parts of a number of steps, to see that its own error is no accident
ACCIDENT = 3  # times the fewest steps at most, for an error that is no accident of the grid
FINER, FINE = 1.1, 1.02  # from one number of steps to the next where errors are uneven, many or few
BETWEEN = 20, 400  # numbers of steps at least and at most, where the error of all these was far below the target


def fewest_uneven(search: Search, final: np.ndarray, start: int = 0) -> tuple[int, float] | None:
    """The fewest steps of a scan whose own run meets the aim, with runs beside it near.

    The numbers of steps are 2 % apart where these are few, and else 10 % and then 1 %. They begin at a quarter of
    what stability asks for, half if that is many, or at ``start``. An error far below the target beside others that
    are not is an accident of where the jumps fall on that grid: it is taken only if no other number of steps up to
    three times as many will do. Where only an error far below the target was found, up to 400 numbers of steps are
    run from half as many on: the first that is near the target is taken, or else the fewest that will do.
    """
    many = search.most > search.planned
    num_steps = start or max(1, math.floor(search.interval / search.bound / (2 if many else 4)))
    error_of = functools.cache(functools.partial(search.error_after, final=final))
    beside = lambda n: max(error_of(max(1, round(n * part))) for part in BESIDE)  # noqa: E731
    meets = lambda n: error_of(n) <= AIM and beside(n) <= FACTOR  # noqa: E731
    least, accident, spent, found = num_steps, 0, 0, 0
    longest = lambda: search.most if not search.patience.over else 0  # noqa: E731
    while not found and num_steps <= min(longest(), accident or search.most) and spent <= 3 * search.most:
        if meets(num_steps):
            if error_of(num_steps) >= 1 / FACTOR or beside(num_steps) <= 1 / FACTOR:
                found = num_steps
            accident = accident or ACCIDENT * num_steps
        spent += num_steps
        finer = FINE if num_steps <= search.planned // 64 else FINER
        num_steps = max(num_steps + 1, round(finer * num_steps))
    found = found or accident // ACCIDENT
    if not found:
        return None
    if math.isinf(error_of(round(found / FINER))):
        found = on_edge(search.patience, error_of, found)
    elif error_of(found) < 1 / FACTOR and not many:
        counts = np.linspace(max(least, found / 2), found * FINER, int(np.clip(search.most // found, *BETWEEN)))
        do = [n for n in map(math.ceil, counts) if not search.patience.over and meets(n)]
        found = next((n for n in do if error_of(n) >= 1 / FACTOR), min([*do, found]))
    return found, error_of(found) * search.error * search.scale(final)


def on_edge(patience: Patience, error_of: Callable[[int], float], high: int) -> int:
    """The fewest steps, to a hundredth, that meet the aim and are stable, as they are with dt 1 % larger."""
    low = round(high / FINER)
    while high - low > max(1, EDGE * high) and not patience.over:
        middle = (low + high) // 2
        if error_of(middle) <= AIM and error_of(math.ceil(middle * (1 - MARGIN))) <= FACTOR:
            high = middle
        else:
            low = middle
    return high
