"""A run as the line of Python that makes it."""

from __future__ import annotations

from typing import Any

from jeuler.accuracy.candidates import Candidate, Problem
from jeuler.accuracy.method import is_diffrax

MOST_OURS, MOST_DIFFRAX = 16_384, 4096  # max_steps of solve_adaptive and diffeqsolve where nothing is said


def code_of(candidate: Candidate, problem: Problem, setting: Any, num_steps: int, *, scene: str) -> str:
    """The line for a setting: a number of steps, or (rtol, atol). For a scene, as ``scene`` names it, and `state`.

    It keeps the last state only, as the runs that were timed do.
    """
    field, state, args = "f", "y0", "" if problem.args is None else "args"
    if scene:
        field, state, args = f"{scene}.vector_field", f"{scene}.as_equation(state)[0]", f"{scene}.attributes(state)"
    if is_diffrax(candidate.step):
        return _diffrax(candidate, problem, setting, num_steps, field, f"{state}, {args}" if args else state)
    start = "" if problem.t0 == 0 else f"t0={problem.t0!r}, "
    step = f", step={candidate.code}" if candidate.code else ""
    others = (f", args={args}" if args else "") + (f", breaks={list(problem.breaks)!r}" if problem.breaks else "")
    if candidate.adaptive:
        most = f", max_steps={_round_up(num_steps)}" if num_steps > MOST_OURS else ""
        end = f"{start}t1={problem.t1!r}, rtol={setting[0]!r}, atol={setting[1]!r}"
        return f"jeuler.solve_adaptive({field}, {state}, {end}{step}{most}{others})"
    grid = f"{start}dt={(problem.t1 - problem.t0) / setting!r}, num_steps={setting}, save_every={setting}"
    if scene and not problem.breaks:
        return f"jeuler.simulate({scene}, state, {grid}{step})"
    return f"jeuler.solve({field}, {state}, {grid}{step}{others})"


def _diffrax(candidate: Candidate, problem: Problem, setting: Any, num_steps: int, field: str, state: str) -> str:
    term, times = f"diffrax.ODETerm({field}), {candidate.code}", f"{problem.t0!r}, {problem.t1!r}"
    if not candidate.adaptive:
        dt = (problem.t1 - problem.t0) / setting
        return f"diffrax.diffeqsolve({term}, {times}, {dt!r}, {state}, max_steps={_round_up(setting)})"
    controller = f"diffrax.PIDController(rtol={setting[0]!r}, atol={setting[1]!r})"
    if problem.inner_breaks:
        controller = f"diffrax.ClipStepSizeController({controller}, jump_ts={list(problem.inner_breaks)!r})"
    most = f", max_steps={_round_up(num_steps)}" if num_steps > MOST_DIFFRAX else ""
    return f"diffrax.diffeqsolve({term}, {times}, None, {state}, stepsize_controller={controller}{most})"


def _round_up(num_steps: int) -> int:
    """A power of two with some room."""
    return 1 << (num_steps + num_steps // 8).bit_length()
