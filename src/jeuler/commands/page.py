"""The fit of a file as one HTML page."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from jeuler.commands.estimate import Estimate
from jeuler.commands.report import compared, derived, fitted_numbers, heading, used
from jeuler.commands.selection import Measurement

if TYPE_CHECKING:
    from jeuler.plotting.report import FitReport


def page(measured: Measurement, found: Estimate, result: dict[str, Any]) -> FitReport:
    """What is printed, with figures: data and fit, the residual, and the correlation of the errors."""
    from jeuler.plotting.report import FitReport, Parameter, Shown

    observed, predicted = (x.reshape(len(measured.times), -1) for x in (measured.positions, found.predicted))
    spread = " and ".join(f"{name} = {value:.5g} {unit}" for name, value, _, unit in fitted_numbers(result)[:2])
    return FitReport(
        title=f"Fit of {heading(result)}",
        verdict=f"{spread}. The fit {result['message']} in {result['iterations']} iterations.",
        shown=[Shown(measured.times, observed, predicted, measured.names, measured.unit, measured.quantity)],
        parameters=[
            Parameter(name, value, _error(value, error), unit, "" if value else "at its bound 0")
            for name, value, error, unit in fitted_numbers(result)
        ],
        facts=[*used(result), *derived(result), *compared(result)],
        warnings=result["warnings"],
        next_steps=list(_next_steps(result)),
        correlation=found.correlation,
        history=found.history,
    )


def _error(value: float, error: float | None) -> float | None:
    """The standard error; infinite where the data do not determine the value, None at the bound 0."""
    return error if error is not None else (float("inf") if value else None)


def _next_steps(result: dict[str, Any]) -> Iterator[str]:
    if not result["converged"]:
        yield "The fit did not converge: raise --max-iterations or give --start before any number is used."
    if result["warnings"]:
        yield "Each warning above says what to do; after that, fit again."
    elif not result.get("comparison"):
        yield "Try --friction compare: it tells whether the data ask for viscous, quadratic or dry friction."
    yield "Record the motion once more and compare: the difference between two recordings shows the error that counts."
