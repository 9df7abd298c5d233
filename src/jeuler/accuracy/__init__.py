"""What accuracy costs in time: work-precision tables, and the dt that a target error needs."""

from jeuler.accuracy._work_precision import work_precision
from jeuler.accuracy.advice import advise_step
from jeuler.accuracy.answer import StepAdvice
from jeuler.accuracy.choice import MethodAdvice, RankedMethod, advise_method
from jeuler.accuracy.method import Compensated, Method
from jeuler.accuracy.table import WorkPrecision

__all__ = [
    "Compensated",
    "Method",
    "MethodAdvice",
    "RankedMethod",
    "StepAdvice",
    "WorkPrecision",
    "advise_method",
    "advise_step",
    "work_precision",
]


def __dir__() -> list[str]:
    return __all__
