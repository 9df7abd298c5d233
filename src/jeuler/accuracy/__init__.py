"""What accuracy costs in time: work-precision tables, and the dt that a target error needs."""

from jeuler.accuracy.advice import StepAdvice, advise_step
from jeuler.accuracy.methods import Compensated
from jeuler.accuracy.table import WorkPrecision
from jeuler.accuracy.work_precision import work_precision

__all__ = ["Compensated", "StepAdvice", "WorkPrecision", "advise_step", "work_precision"]
