"""Where a run or its gradient stops being finite, why, and what to do."""

from jeuler.diagnosis._diagnose import Diagnosis, diagnose

__all__ = [
    "Diagnosis",
    "diagnose",
]


def __dir__() -> list[str]:
    return __all__
