"""What accuracy costs in time: work-precision tables, and the dt that a target error needs."""

from jeuler.accuracy.methods import Compensated
from jeuler.accuracy.table import WorkPrecision
from jeuler.accuracy.work_precision import work_precision

__all__ = ["Compensated", "WorkPrecision", "work_precision"]
