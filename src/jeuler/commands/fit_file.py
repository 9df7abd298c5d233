"""From a measured file to ks and kd: what the command line does, step by step."""

from __future__ import annotations

import argparse
import json
import os
import time
from typing import Any

import jax
import numpy as np

from jeuler._core.component import replace
from jeuler._core.files import write_atomically
from jeuler.commands import options
from jeuler.commands.options import EXAMPLE, Measurement
from jeuler.fitting import SpringFit, fit_springs
from jeuler.fitting.oscillation import Mode, Oscillation, estimate_oscillation, modes
from jeuler.forces import QuadraticDrag, Springs
from jeuler.particles._simulate import simulate
from jeuler.particles.scene import Scene
from jeuler.particles.state import ParticleState
from jeuler.steps.explicit import rk4_step

DEFAULT_PICTURE = "jeuler_fit.png"


def fit_file(arguments: argparse.Namespace, started: float) -> None:
    """Read, fit, print, draw."""
    measured = options.example() if arguments.file is None else options.read(arguments)
    particles, dim = measured.positions.shape[1:]
    mass = options.masses(arguments.mass, particles) if arguments.file else np.array([EXAMPLE["mass"]])
    pairs, anchored = options.edges(arguments.edges, particles)
    guess = estimate_oscillation(measured.times, measured.positions.reshape(len(measured.times), -1))
    start = options.start(arguments.start)
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


def _build(
    measured: Measurement,
    mass: np.ndarray,
    pairs: list[tuple[int, int]],
    anchored: list[int],
    guess: Oscillation,
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
    return modes(found.scene, replace(found.state, position=found.state.position * 0 + unmoved))


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
