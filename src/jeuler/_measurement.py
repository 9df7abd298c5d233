"""From a measured file to ks and kd: what the command line does, step by step."""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import re
import time
from typing import Any

import jax
import numpy as np

from jeuler import _tree
from jeuler._files import write_atomically
from jeuler.fitting import SpringFit, fit_springs
from jeuler.fitting.oscillation import Mode, estimate_oscillation, modes
from jeuler.forces import QuadraticDrag, Springs
from jeuler.methods import rk4_step
from jeuler.particles import ParticleState, Scene, simulate
from jeuler.trajectory import read_trajectory

DEFAULT_PICTURE = "jeuler_fit.png"
EXAMPLE = {"mass": 0.5, "ks": 20.0, "kd": 0.3, "rest": 0.1, "noise": 0.001}


@dataclasses.dataclass(frozen=True)
class Measurement:
    """Positions of particles over time: times (time,), positions (time, particle, dim), names (particle, dim)."""

    source: str
    times: np.ndarray
    positions: np.ndarray
    names: list[str]


def fit_file(arguments: argparse.Namespace, started: float) -> None:
    """Read, fit, print, draw."""
    measured = example() if arguments.file is None else read(arguments)
    particles, dim = measured.positions.shape[1:]
    mass = _masses(arguments.mass, particles) if arguments.file else np.array([EXAMPLE["mass"]])
    pairs, anchored = _edges(arguments.edges, particles)
    guess = estimate_oscillation(measured.times, measured.positions.reshape(len(measured.times), -1))
    start = _start(arguments.start)
    scene, state, parameters = _build(measured, mass, pairs, anchored, guess, start, arguments.drag)
    dt = arguments.dt or min(2 * np.pi / guess.angular_frequency / 40, np.ptp(measured.times) / 100)
    hidden = np.full((len(measured.times), len(anchored), dim), np.nan)
    targets = np.concatenate([measured.positions, hidden], axis=1)
    found = fit_springs(
        scene,
        state,
        measured.times,
        targets,
        dt=dt,
        t0=measured.times[0],
        parameters=parameters,
        max_iterations=arguments.max_iterations,
    )
    report = _report(measured, found, mass, pairs, anchored, dt)
    picture = arguments.plot or DEFAULT_PICTURE
    _draw(measured, found, picture, dt, report)
    report["seconds"] = time.perf_counter() - started
    if arguments.json:
        text = json.dumps(report, indent=2)
        write_atomically(arguments.json, lambda path: _write_text(path, text))
    _print(report, picture, example=arguments.file is None)


def _write_text(path: str, text: str) -> None:
    with open(path, "w", encoding="utf-8") as file:
        file.write(text + "\n")


def example() -> Measurement:
    """A damped spring, solved by diffrax to 1e-10 and given noise: data that the fit's own steps did not make."""
    import diffrax
    import jax.numpy as jnp

    def field(t, y, _):
        x, v = y
        force = -EXAMPLE["ks"] * (x - EXAMPLE["rest"]) - EXAMPLE["kd"] * v
        return v, force / EXAMPLE["mass"]

    times = np.linspace(0.0, 8.0, 241)
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(field),
        diffrax.Tsit5(),
        0.0,
        8.0,
        1e-3,
        (jnp.asarray(0.16), jnp.asarray(0.0)),
        saveat=diffrax.SaveAt(ts=jnp.asarray(times)),
        stepsize_controller=diffrax.PIDController(rtol=1e-10, atol=1e-10),
    )
    noise = EXAMPLE["noise"] * np.random.default_rng(7).standard_normal(len(times))
    return Measurement("built-in example", times, (np.asarray(solution.ys[0]) + noise)[:, None, None], ["x"])


def read(arguments: argparse.Namespace) -> Measurement:
    """The file's positions as (time, particle, dim)."""
    times, columns = read_trajectory(arguments.file)
    keep = np.ones(len(times), bool)
    if arguments.begin is not None:
        keep &= times >= arguments.begin
    if arguments.end is not None:
        keep &= times <= arguments.end
    if keep.sum() < 5:
        raise ValueError(
            f"{arguments.file}: {keep.sum()} rows between --from and --to, expected 5 at least; "
            f"the times run from {times.min():g} to {times.max():g} s"
        )
    names, dim = _position_columns(list(columns), arguments)
    values = np.stack([columns[name] for name in names], axis=1)[keep]
    return Measurement(arguments.file, times[keep], values.reshape(len(values), -1, dim), names)


def _position_columns(available: list[str], arguments: argparse.Namespace) -> tuple[list[str], int]:
    """Which columns are positions, particle by particle, and how many coordinates each has."""
    if arguments.columns:
        names = [name.strip() for name in arguments.columns.split(",")]
        unknown = [name for name in names if name not in available]
        if unknown:
            raise ValueError(f"{arguments.file}: no column {unknown[0]!r}, the columns are {', '.join(available)}")
    else:
        names = [name for name in available if re.match(r"[xyz]($|[^a-z])", name.lower())] or available
    axes = [name[0].lower() for name in names]
    # x1 y1 x2 y2: a particle has as many coordinates as there are different letters
    told = len(set(axes)) if set(axes) <= set("xyz") else (len(names) if len(names) <= 3 else 1)
    dim = told if arguments.dim is None else arguments.dim
    if dim < 1 or len(names) % dim:
        raise ValueError(
            f"{arguments.file}: {len(names)} position columns ({', '.join(names)}) do not make particles of "
            f"{dim} coordinates; choose with --columns and --dim"
        )
    if dim > 1 and set(axes) <= set("xyz") and any(len(set(axes[k : k + dim])) < dim for k in range(0, len(axes), dim)):
        particle = [re.sub(r"\D", "", name) for name in names]
        names = [name for _, name in sorted(zip(particle, names, strict=True))]
    return names, dim


def _floats(option: str, text: str) -> list[float]:
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        raise ValueError(f"{option} must be numbers separated by commas, got {text!r}") from None


def _masses(text: str, particles: int) -> np.ndarray:
    masses = np.array(_floats("--mass", text))
    if len(masses) not in (1, particles) or not (masses > 0).all() or not np.isfinite(masses).all():
        raise ValueError(f"--mass must be one positive number of kg or {particles}, one a particle, got {text!r}")
    return np.broadcast_to(masses, particles)


def _edges(text: str | None, particles: int) -> tuple[list[tuple[int, int]], list[int]]:
    """Pairs of particles joined by springs, and particles joined to an anchor each; indices from 0."""
    pairs, anchored = [], []
    for part in text.split(",") if text else [f"{k + 1}-anchor" for k in range(particles)]:
        found = re.fullmatch(r"\s*(\d+)\s*-\s*(\d+|anchor|a)\s*", part)
        ends = [int(x) - 1 for x in found.groups() if x.isdigit()] if found else []
        if not found or not all(0 <= k < particles for k in ends) or (len(ends) == 2 and ends[0] == ends[1]):
            raise ValueError(
                f"--edges must be like 1-2,2-anchor with particles from 1 to {particles}, got {part.strip()!r}"
            )
        if len(ends) == 2:
            pairs.append((ends[0], ends[1]))
        else:
            anchored.append(ends[0])
    return pairs, anchored


def _start(text: str | None) -> dict[str, float]:
    """ks=20,kd=0.3 as numbers."""
    start = {}
    for part in text.split(",") if text else []:
        found = re.fullmatch(r"\s*(ks|kd)\s*=\s*(\S+)\s*", part)
        value = _floats("--start", found.group(2))[0] if found else -1.0
        if not found or not 0 < value < np.inf:
            raise ValueError(f"--start must be like ks=20,kd=0.3 with positive numbers, got {part.strip()!r}")
        start[found.group(1)] = value
    return start


def _build(
    measured: Measurement,
    mass: np.ndarray,
    pairs: list[tuple[int, int]],
    anchored: list[int],
    guess: Any,
    start: dict[str, float],
    drag: str | None,
) -> tuple[Scene, ParticleState, tuple[str, ...]]:
    """The scene as the search starts with it, and what is free in it."""
    particles, dim = measured.positions.shape[1:]
    if not np.isfinite(measured.positions).any(axis=(0, 2)).all():
        raise ValueError(f"{measured.source}: a particle without any position; leave it out with --columns")
    rest = np.nanmean(measured.positions, axis=0)
    position = np.stack([_first_seen(measured.positions[:, k], rest[k]) for k in range(particles)])
    ks = start.get("ks", float(np.mean(mass)) * guess.angular_frequency**2)
    kd = start.get("kd", 2 * float(np.mean(mass)) * guess.decay_rate)
    forces: list[Any] = []
    names = []
    if anchored:
        edges = [(k, particles + index) for index, k in enumerate(anchored)]
        forces.append(Springs(edges, np.full(len(edges), ks), np.full(len(edges), kd), 0.0))
        names += ["anchors"]
    if pairs:
        i, j = np.array(pairs).T
        lengths = np.nanmean(np.linalg.norm(measured.positions[:, i] - measured.positions[:, j], axis=-1), axis=0)
        names.append(f"forces[{len(forces)}].rest_length")
        forces.append(Springs(pairs, np.full(len(pairs), ks), np.full(len(pairs), kd), lengths))
    if drag:
        amplitude = np.nanstd(measured.positions)
        forces.append(QuadraticDrag(0.1 * kd / (amplitude * guess.angular_frequency)))
        names.append("coefficient")
    state = ParticleState(
        np.concatenate([position, rest[anchored]]),
        np.zeros((particles + len(anchored), dim)),
        np.concatenate([mass, np.full(len(anchored), np.inf)]),
    )
    return Scene(forces=tuple(forces)), state, ("ks", "kd", "position", "velocity", *names)


def _first_seen(track: np.ndarray, otherwise: np.ndarray) -> np.ndarray:
    seen = np.isfinite(track).all(axis=1)
    return track[np.argmax(seen)] if seen.any() else otherwise


def _report(
    measured: Measurement,
    found: SpringFit,
    mass: np.ndarray,
    pairs: list[tuple[int, int]],
    anchored: list[int],
    dt: float,
) -> dict[str, Any]:
    """Everything that is printed and written, as plain numbers."""
    labels = [f"{k + 1}-anchor" for k in anchored] + [f"{i + 1}-{j + 1}" for i, j in pairs]
    flat = {name: np.concatenate([np.ravel(x) for x in _parts(found.params[name])]) for name in ("ks", "kd")}
    errors = {name: np.concatenate([np.ravel(x) for x in _parts(found.stderr[name])]) for name in ("ks", "kd")}
    springs = [
        {
            "edge": label,
            "ks": float(flat["ks"][k]),
            "ks_stderr": _plain(errors["ks"][k]),
            "kd": float(flat["kd"][k]),
            "kd_stderr": _plain(errors["kd"][k]),
        }
        for k, label in enumerate(labels)
    ]
    rms = float(np.sqrt(found.loss))
    away = measured.positions - np.nanmean(measured.positions, axis=0)
    amplitude = float(np.nanmax(np.linalg.norm(away, axis=-1)))
    report: dict[str, Any] = {
        "source": measured.source,
        "samples": int(np.isfinite(measured.positions).sum()),
        "mass": mass.tolist(),
        "springs": springs,
        "modes": [{"natural_frequency": m.angular_frequency, "damping_ratio": m.damping_ratio} for m in _modes(found)],
        "rms": rms,
        "amplitude": amplitude,
        "share_of_amplitude": rms / amplitude if amplitude else 0.0,
        "dt": float(dt),
        "iterations": len(found.history),
        "converged": bool(found.converged),
        "message": found.message,
    }
    if "anchors" in found.params:
        report["rest_position"] = np.asarray(found.params["anchors"]).tolist()
    if "coefficient" in found.params:
        report["drag_coefficient"] = float(found.params["coefficient"])
        report["drag_coefficient_stderr"] = _plain(found.stderr["coefficient"])
    return report


def _modes(found: SpringFit) -> list[Mode]:
    """Modes at the mean of the fitted motion."""
    unmoved = np.nan_to_num(np.asarray(found.predicted)).mean(axis=0)
    return modes(found.scene, _tree.replace(found.state, position=found.state.position * 0 + unmoved))


def _parts(x: Any) -> tuple:
    return x if isinstance(x, tuple) else (x,)


def _plain(x: Any) -> float | None:
    """A number that JSON can hold."""
    return float(x) if np.isfinite(x) else None


def _draw(measured: Measurement, found: SpringFit, picture: str, dt: float, report: dict[str, Any]) -> None:
    import matplotlib.pyplot as plt

    from jeuler.plotting import plot_fit

    particles = measured.positions.shape[1]
    t0, count = measured.times[0], len(measured.times)
    steps = int(np.ceil((measured.times[-1] - t0) / dt))
    run = jax.jit(lambda: simulate(found.scene, found.state, dt=dt, num_steps=steps, t0=t0, step=rk4_step))()
    spring = report["springs"][0]
    source = os.path.basename(measured.source)
    title = f"{source}: ks = {spring['ks']:.4g} N/m, kd = {spring['kd']:.3g} N s/m"
    if len(report["springs"]) > 1:
        title = f"{source}: {len(report['springs'])} springs fitted"
    figure = plot_fit(
        measured.times,
        measured.positions.reshape(count, -1),
        np.asarray(found.predicted)[:, :particles].reshape(count, -1),
        names=tuple(measured.names),
        curve=(run.t, np.asarray(run.y.position)[:, :particles].reshape(steps + 1, -1)),
        title=title,
    )
    write_atomically(picture, lambda path: figure.savefig(path, dpi=130, format=picture.rpartition(".")[2]))
    plt.close(figure)


def _print(report: dict[str, Any], picture: str, example: bool) -> None:
    def line(name: str, value: Any, error: Any, unit: str, note: str = "") -> None:
        spread = f" ± {error:.2g}" if error is not None else " (not determined by the data)"
        print(f"  {name:<24} {value:.5g}{spread} {unit}{note}")

    print(f"{report['source']}: {report['samples']} samples, mass {', '.join(f'{m:g}' for m in report['mass'])} kg")
    for spring in report["springs"]:
        where = "" if len(report["springs"]) == 1 else f" of {spring['edge']}"
        for name, unit in (("ks", "N/m"), ("kd", "N s/m")):
            note = f"   (true {EXAMPLE[name]:g})" if example else ""
            line(name + where, spring[name], spring[name + "_stderr"], unit, note)
    if "drag_coefficient" in report:
        line("drag coefficient", report["drag_coefficient"], report["drag_coefficient_stderr"], "kg/m")
    for mode in report["modes"]:
        omega = mode["natural_frequency"]
        hertz, squared = omega / (2 * np.pi), omega**2
        print(f"  {'natural frequency':<24} {omega:.5g} rad/s = {hertz:.4g} Hz (squared {squared:.4g} 1/s^2)")
        print(f"  {'damping ratio':<24} {mode['damping_ratio']:.4g}")
    share = f"{100 * report['share_of_amplitude']:.2g} % of the amplitude {report['amplitude']:.3g} m"
    print(f"  {'residual RMS':<24} {report['rms']:.3g} m, {share}")
    print(f"  {'fit':<24} {report['message']}, {report['iterations']} iterations")
    print(f"  {'time':<24} {report['seconds']:.1f} s in all")
    print(f"  {'picture':<24} {picture}")
