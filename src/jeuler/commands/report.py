"""The result as text and as JSON."""

from __future__ import annotations

from typing import Any

import numpy as np

from jeuler.commands.cautions import lag_one
from jeuler.commands.estimate import Estimate
from jeuler.commands.options import EXAMPLE
from jeuler.commands.selection import Measurement
from jeuler.fitting.recordings.table import listed

SCHEMA, VERSION = "jeuler.fit", 1
G = 9.80665


def report(measured: Measurement, found: Estimate, warnings: list[str]) -> dict[str, Any]:
    """Everything that is printed and written, as plain numbers; the schema is in docs/recordings.md."""
    model = found.model
    rms = float(np.sqrt(found.loss))
    away = measured.positions - np.nanmean(measured.positions, axis=0)
    amplitude = float(np.nanmax(np.linalg.norm(np.where(np.isfinite(away), away, 0), axis=-1)))
    residual = (measured.positions - found.predicted).reshape(len(measured.times), -1)
    sampling = measured.sampling
    return {
        "schema": SCHEMA,
        "version": VERSION,
        "source": measured.source,
        "run": measured.run,
        "time": measured.clock,
        "columns": measured.names,
        "quantity": measured.quantity,
        "unit": measured.unit,
        "span": [float(measured.times[0]), float(measured.times[-1])],
        "rate": None if sampling is None else _plain(sampling.rate),
        "left_out": [{"column": name, "reason": reason} for name, reason in measured.left_out],
        "notes": list(measured.notes),
        "warnings": warnings,
        "samples": int(np.isfinite(measured.positions).sum()),
        "mass": found.mass.tolist(),
        "springs": _springs(found),
        "friction": list(model.friction),
        **_extras(found),
        "modes": [{"natural_frequency": m.angular_frequency, "damping_ratio": m.damping_ratio} for m in found.modes],
        "equation": equation(measured, found),
        "rms": rms,
        "amplitude": amplitude,
        "share_of_amplitude": rms / amplitude if amplitude else 0.0,
        "residual_lag_one": lag_one(residual),
        "stderr_widened_by": found.widening,
        "dt": float(found.dt),
        "iterations": found.iterations,
        "converged": found.converged,
        "message": found.message,
    }


def _springs(found: Estimate) -> list[dict[str, Any]]:
    ks, ks_error = np.atleast_1d(found.params["ks"]), np.atleast_1d(found.stderr["ks"])
    kd = np.atleast_1d(found.params.get("kd", np.zeros_like(ks)))
    kd_error = np.atleast_1d(found.stderr.get("kd", np.full_like(ks, np.inf)))
    return [
        {
            "edge": label,
            "ks": float(ks[k]),
            "ks_stderr": _plain(ks_error[k]),
            "kd": float(kd[k]),
            "kd_stderr": _plain(kd_error[k]),
        }
        for k, label in enumerate(found.model.labels)
    ]


def _extras(found: Estimate) -> dict[str, Any]:
    """Parameters that only some models have."""
    names = {
        "quadratic": "drag_coefficient",
        "dry": "dry_friction",
        "spring_mass": "spring_mass",
        "cubic": "cubic",
        "gain": "gain",
    }
    extras: dict[str, Any] = {}
    for name, key in names.items():
        if name in found.params:
            extras[key] = float(found.params[name])
            extras[key + "_stderr"] = _plain(float(found.stderr[name]))
    if "mass" in found.params:
        extras["mass_stderr"] = [_plain(x) for x in np.atleast_1d(found.stderr["mass"])]
    if "anchors" in found.params:
        extras["rest_position"] = found.params["anchors"].tolist()
    elif found.model.observe in ("position", "angle"):
        extras["rest_position"] = found.params["offset"].tolist()
    else:
        extras["offset"] = found.params["offset"].tolist()
    if found.model.delay:
        extras["delay"] = np.asarray(found.model.delays(found.params)).tolist()
        errors = iter(np.atleast_1d(found.stderr.get("delay", [])))
        extras["delay_stderr"] = [_plain(next(errors)) if np.isnan(late) else None for late in found.model.delay]
    if found.model.drift:
        extras["drift"] = found.params["drift"].tolist()
        extras["drift_stderr"] = [[list(map(_plain, row)) for row in rows] for rows in found.stderr["drift"]]
    if found.model.pendulum:
        extras["pendulum_length"] = G / float(np.atleast_1d(found.params["ks"])[0]) * float(found.mass[0])
    return extras


def _plain(x: Any) -> float | None:
    """A number that JSON can hold."""
    return float(x) if np.isfinite(x) else None


def equation(measured: Measurement, found: Estimate) -> str:
    """The equation of motion of the first particle, with its numbers in it; "" for several particles."""
    model, params = found.model, found.params
    if model.particles > 1 and not model.shared:
        return ""
    rest = float(np.ravel(params["offset"])[0]) if model.observe in ("position", "angle") and model.dim == 1 else 0.0
    letter = "angle" if model.pendulum or model.observe.startswith("ang") else "x"
    velocity, moving = f"{letter}'", " - drift(t)" if model.drift else ""
    if model.moves_support:
        rest -= float(np.mean(measured.drive if measured.drive is not None else 0.0))
        moving, velocity = moving + f" - s({_late(found)})", f"({letter}' - s'({_late(found)}))"
    place = f"({letter} - {rest:.4g}{moving})".replace("- -", "+ ") if rest or moving else letter
    ks = float(np.atleast_1d(params["ks"])[0])
    mass = f"{found.mass[0]:.4g}" if not model.shared else "m"
    parts = [
        f"{mass} {letter}'' = -{ks:.5g} " + (f"sin{place if rest else f'({letter})'}" if model.pendulum else place)
    ]
    if "cubic" in params:
        parts.append(f"- {float(params['cubic']):.4g} {place}^3")
    if "kd" in params:
        parts.append(f"- {float(np.atleast_1d(params['kd'])[0]):.4g} {velocity}")
    if "quadratic" in params:
        parts.append(f"- {float(params['quadratic']):.4g} |{letter}'| {letter}'")
    if "dry" in params:
        parts.append(f"- {float(params['dry']):.4g} sign({letter}')")
    if "gain" in params:
        parts.append(f"+ {float(params['gain']):.4g} u({_late(found)})")
    return " ".join(parts).replace("- -", "+ ")


def _late(found: Estimate) -> str:
    """The time at which a driven motion sees its input."""
    late = float(found.model.delays(found.params)[0]) if found.model.delay else 0.0
    return f"t - {late:.4g}".replace("- -", "+ ") if late else "t"


Fact = tuple[str, str]  # its name, and its value in words


def lines(result: dict[str, Any], picture: str | None, example: bool) -> list[str]:
    """The result as lines of text."""
    numbers = []
    for name, value, error, unit in fitted_numbers(result):
        note = f"   (true {EXAMPLE[name]:g})" if example and name in ("ks", "kd") else ""
        numbers.append(_line(name, value, error, unit, note))
    after = [*derived(result), ("time", f"{result['seconds']:.1f} s in all")]
    if picture is not None:
        after.append(("picture", picture))
    after += [("WARNING", warning) for warning in result["warnings"]]
    return [heading(result), *map(_fact_line, used(result)), *numbers, *map(_fact_line, after)]


def _fact_line(fact: Fact) -> str:
    name, words = fact
    return f"  {name:<24} {words}"


def used(result: dict[str, Any]) -> list[Fact]:
    """Which part of the recording was used, and what was left out."""
    facts = [("used", _used(result))]
    if result["left_out"]:
        out = [f"{listed([entry['column']])} ({entry['reason']})" for entry in result["left_out"]]
        longest = max(map(len, out))  # a name may be cut, a reason not
        facts.append(("left out", listed(out, longest=longest)))
    return facts + [("note", note) for note in result["notes"]]


def fitted_numbers(result: dict[str, Any]) -> list[tuple[str, float, float | None, str]]:
    """Name, value, standard error and unit of each number of the model."""
    units, numbers = _units(result), []
    for spring in result["springs"]:
        where = "" if len(result["springs"]) == 1 else f" of {spring['edge']}"
        for name in ("ks", "kd"):
            if name == "kd" and "viscous" not in result["friction"]:
                continue
            numbers.append((name + where, spring[name], spring[name + "_stderr"], units[name]))
    for key, name in (
        ("drag_coefficient", "drag coefficient"),
        ("dry_friction", "dry friction"),
        ("spring_mass", "mass of the spring"),
        ("cubic", "cubic stiffness"),
        ("gain", "gain of the input"),
    ):
        if key in result:
            numbers.append((name, result[key], result[key + "_stderr"], units[key]))
    fitted = [k for k, error in enumerate(result.get("delay_stderr", [])) if error is not None]
    for k in fitted:
        name = "delay" if len(result["delay"]) == 1 else f"delay of particle {k + 1}"
        numbers.append((name, result["delay"][k], result["delay_stderr"][k], "s"))
    return numbers


def derived(result: dict[str, Any]) -> list[Fact]:
    """What follows from the parameters, and how far they can be trusted."""
    facts = []
    if "pendulum_length" in result:
        facts.append(("length", f"{result['pendulum_length']:.4g} m, of a point mass at g = {G} m/s^2"))
    for mode in result["modes"]:
        omega = mode["natural_frequency"]
        hertz = omega / (2 * np.pi)
        facts.append(("natural frequency", f"{omega:.5g} rad/s = {hertz:.4g} Hz (squared {omega**2:.4g} 1/s^2)"))
        facts.append(("damping ratio", f"{mode['damping_ratio'] + 0.0:.4g}"))
    if result["equation"]:
        facts.append(("equation", result["equation"]))
    unit = result["unit"]
    facts += _drift_facts(result)
    share = f"{100 * result['share_of_amplitude']:.2g} % of the amplitude {result['amplitude']:.3g} {unit}"
    facts.append(("residual RMS", f"{result['rms']:.3g} {unit}, {share}"))
    if result["stderr_widened_by"] > 1.05:
        facts.append(("errors", f"widened {result['stderr_widened_by']:.2g} times, as the residual is correlated"))
    facts.append(("trust", _trust(result)))
    facts.append(("fit", f"{result['message']}, {result['iterations']} iterations"))
    return facts


def _drift_facts(result: dict[str, Any]) -> list[Fact]:
    """How the zero of each channel moves over the record."""
    if "drift" not in result:
        return []
    coefficients = np.asarray(result["drift"]).reshape(len(result["drift"]), -1)
    powers = np.linspace(-1, 1, 201)[:, None] ** np.arange(1, len(coefficients) + 1)
    moves = powers @ coefficients
    return [
        (
            f"drift of {name[:15]}",
            f"{moved[-1] - moved[0]:.3g} {result['unit']} from the first to the last row"
            + (f", {np.ptp(moved):.3g} at most" if len(coefficients) > 1 else ""),
        )
        for name, moved in zip(result["columns"], moves.T, strict=True)
    ]


def compared(result: dict[str, Any]) -> list[Fact]:
    """The friction laws that were compared, the best first."""
    rows = sorted(result.get("comparison", []), key=lambda row: row["score"])
    return [
        (
            f"friction {row['friction']}",
            f"residual RMS {row['rms']:.4g} {result['unit']}, "
            + ("the best" if k == 0 else f"worse by {row['score']:.3g}")
            + (" (over 10: clearly)" if row["score"] > 10 else ""),
        )
        for k, row in enumerate(rows)
    ]


def heading(result: dict[str, Any]) -> str:
    masses = ", ".join(f"{m:.4g}" for m in result["mass"])
    run = f", run {result['run']}" if result["run"] else ""
    inertia = "inertia" if result["quantity"].startswith("ang") else "mass"
    unit = "kg m^2" if inertia == "inertia" else "kg"
    return f"{result['source']}{run}: {result['samples']} samples, {inertia} {masses} {unit}"


def _used(result: dict[str, Any]) -> str:
    rate = f", {result['rate']:.4g} samples a second" if result["rate"] else ""
    names = listed(list(dict.fromkeys(result["columns"])))
    begin, end = result["span"]
    return (
        f"{result['quantity']} {names} in {result['unit']} over {result['time']} from {begin:.5g} to {end:.5g} s{rate}"
    )


def _units(result: dict[str, Any]) -> dict[str, str]:
    if result["quantity"] in ("angle", "angular velocity"):
        return {
            "ks": "N m/rad",
            "kd": "N m s/rad",
            "drag_coefficient": "N m s^2/rad^2",
            "dry_friction": "N m",
            "spring_mass": "kg m^2",
            "cubic": "N m/rad^3",
            "gain": "N m per unit",
        }
    return {
        "ks": "N/m",
        "kd": "N s/m",
        "drag_coefficient": "kg/m",
        "dry_friction": "N",
        "spring_mass": "kg",
        "cubic": "N/m^3",
        "gain": "N per unit",
    }


def _line(name: str, value: float, error: float | None, unit: str, note: str = "") -> str:
    spread = f" ± {error:.2g}" if error is not None else ("" if value == 0 else " (not determined by the data)")
    return f"  {name:<24} {value:.5g}{spread} {unit}{note}"


def _trust(result: dict[str, Any]) -> str:
    """How well each of ks and kd is known, in one line."""
    words = []
    for spring in result["springs"]:
        where = "" if len(result["springs"]) == 1 else f" of {spring['edge']}"
        for name in ("ks", "kd"):
            if name == "kd" and "viscous" not in result["friction"]:
                continue
            value, error = spring[name], spring[name + "_stderr"]
            if value == 0:
                words.append(f"{name}{where} at its bound 0")
            elif error is None:
                words.append(f"{name}{where} not determined")
            else:
                words.append(f"{name}{where} to {_percent(200 * error / abs(value))}")
    ending = " (95 %), if the model and the mass are right" + ("; see the warnings" if result["warnings"] else "")
    return ", ".join(words) + ending


def _percent(share: float) -> str:
    return "100 % or more" if share >= 100 else f"{max(share, 0.001):.2g} %"
