"""The fit of a scene to recordings of any sensor: from checked input to what it is worth."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jeuler._core import checks
from jeuler.fitting.asked import ASKED
from jeuler.fitting.beside import attached
from jeuler.fitting.engine import Outcome, run
from jeuler.fitting.measured.form import (
    as_positions,
    as_sensor,
    delay_bounds,
    grouped,
    own_names,
    period_of,
    refuse_strangers,
    stacked,
    starting_values,
)
from jeuler.fitting.measured.readings import SENSOR_PARAMETERS, Readings, compiled_readings, compiled_residual
from jeuler.fitting.measured.recording import Checked, Recording, completed
from jeuler.fitting.observations import noise_of, variance_of
from jeuler.fitting.options import Known, Options
from jeuler.fitting.parameters import Places
from jeuler.fitting.priors import Alike
from jeuler.fitting.problem import Problem
from jeuler.fitting.result import Fit
from jeuler.fitting.series import Columns, Series, one_after_another
from jeuler.fitting.smoothness import alike_neighbours
from jeuler.fitting.step_bias import RANDOM, UNKNOWN, shifted
from jeuler.fitting.two_starts import from_both
from jeuler.fitting.unknowns import size_of
from jeuler.fitting.weak_form import weak_form
from jeuler.particles.fields import draws
from jeuler.particles.scene import Scene
from jeuler.particles.state import ParticleState
from jeuler.solving.grid import Checkpoint
from jeuler.steps.explicit import Step

SHARES = (1 / 16, 1 / 8, 1 / 4, 1 / 2)  # of its span that is fitted in each stage


@dataclasses.dataclass(frozen=True)
class Several:
    """Recordings of one scene, and what is free.

    Attributes:
      single: whether it is one record, not a list of them: no leading axis of what is its own.
    """

    scene: Scene
    records: tuple[Checked, ...]
    residual: Readings
    start: dict[str, Any]
    dt: float
    single: bool
    bounds: dict[str, Any]
    key: Any = None

    @classmethod
    def of(
        cls,
        scene: Scene,
        state: ParticleState | None,
        recordings: Sequence[Recording],
        *,
        single: bool,
        observe: Any,
        per_recording: Any,
        dt: Any,
        t0: Any,
        step: Step,
        names: Any,
        where: Any,
        ties: Any,
        bounds: Any,
        sigma: Any,
        weights: Any,
        key: Any = None,
        checkpoint: Checkpoint = None,
    ) -> Several:
        """Checked, or one ValueError."""
        checks.kind("scene", scene, Scene)
        checks.positive("dt", dt, "s")
        checks.number("t0", t0)
        filled = [completed(each, scene, state, t0, observe, sigma, weights) for each in recordings]
        sensors = [as_sensor(each.observe) for each in filled]
        given = tuple(names) if not isinstance(names, str) else names
        of_sensor = tuple(name for name in given if name in SENSOR_PARAMETERS) if isinstance(given, tuple) else ()
        of_scene = tuple(name for name in given if name not in of_sensor) if isinstance(given, tuple) else given
        bounds, late = delay_bounds(bounds, of_sensor, filled)
        labels = [""] if single else [f"recordings[{k}]." for k in range(len(filled))]
        records = tuple(
            Checked.of(dataclasses.replace(each, observe=sensor), label, float(dt), late)
            for each, sensor, label in zip(filled, sensors, labels, strict=True)
        )
        refuse_strangers(scene, records)
        places = Places.of(records[0].state, of_scene, where, ties, scene, least=0 if of_sensor else 1)
        own = () if single else own_names(per_recording, (*places.names, *of_sensor))
        start = starting_values(scene, records, places, of_sensor, own)
        groups = grouped(records, float(dt))
        periods = tuple(period_of(records[g.members[0]].sensor) for g in groups)
        unknowns = sum(np.size(leaf) for leaf in jax.tree.leaves(start))
        numbers = sum(len(g.members) * g.num_steps for g in groups) * records[0].state.position.size * unknowns
        residual = Readings(places, of_sensor, own, step, groups, periods, numbers, checkpoint)
        return cls(scene, records, residual, start, float(dt), single, places.bounds(scene, bounds), key)

    @property
    def traced(self) -> bool:
        parts = (self.scene, self.start, [(r.scene, r.state, r.targets, r.sensor) for r in self.records])
        return any(map(checks.is_traced, jax.tree.leaves(parts)))

    def data(self, parts: int = 1) -> list[dict[str, Any]]:
        """The recordings as the compiled programs take them, a dict a group; ``parts`` steps for each step."""
        found = []
        for group in self.residual.groups:
            count = max(group.lengths)
            steps = group.num_steps * parts
            each = [{**self.records[k].data(self.dt / parts, steps, count), "key": self.key} for k in group.members]
            found.append(jax.tree.map(stacked, *each))
        return found

    def problem(self, start: dict[str, Any], stages: Any, priors: Any, loss: str, alike: Alike) -> Problem:
        """The least-squares problem from this start."""
        sigma, weights = [], []
        xp: Any = jnp if self.traced else np
        given = [r.sigma is not None for r in self.records]
        if any(given) and not all(given):
            raise ValueError("sigma must be given for all recordings or for none, got some of each")
        for r in self.records:
            seen, columns = r.seen[:, np.asarray(r.columns, int)], np.asarray(r.columns, int)
            if r.sigma is not None:
                sigma.append(xp.where(seen, r.sigma.reshape(len(r.times), -1)[:, columns], np.inf))
            own = 1.0 if r.weights is None else r.weights.reshape(len(r.times), -1)[:, columns]
            weights.append(xp.where(seen, own, 0.0))
        positive = {**self.residual.places.positive(self.scene), **dict.fromkeys(self.residual.of_sensor, False)}
        return Problem.of(
            self.residual,
            start,
            data=self.data(),
            bounds=self.bounds or None,
            positive=positive,
            sigma=tuple(sigma) if all(given) else None,
            weights=None if all(given) else tuple(weights),
            stages=stages,
            priors=priors,
            loss=loss,
            alike=alike,
        )

    def fit(self, options: Options, start: str, grow: bool, priors: Any, smoothness: Any) -> tuple[Outcome, str]:
        """Search from the data, where positions were measured, and from the given values."""
        stages = self._stages() if grow and not self.traced else ()
        alike = alike_neighbours(self.scene, self.residual.places, smoothness)
        given = self.problem(self.start, stages, priors, options.loss, alike)
        if self.traced:
            return run(given, options, scale=self._scale()), "given"
        begun = self._from_data(given) if start == "data" else None
        return from_both(given, begun, options, self._scale(), self._known(given))

    def _from_data(self, given: Problem) -> Problem | None:
        """The same problem from what the weak form finds in measured positions; of several, where it leaves least."""
        best, own = None, {}
        for k, r in enumerate(self.records):
            targets = as_positions(r)
            start = {n: v for n, v in self.start.items() if n not in self.residual.of_sensor}
            start = {n: v[k] if n in self.residual.own else v for n, v in start.items()}
            places = self.residual.places
            found = None if targets is None else weak_form(r.scene, r.state, r.times, targets, places, start)
            if found is None:
                return None
            own[k] = found.params
            if best is None or found.residual < best.residual:
                best = found
        assert best is not None
        params = {**self.start, **best.params}
        for name in self.residual.own:
            if name not in self.residual.of_sensor:
                params[name] = np.stack([np.asarray(own[k][name]) for k in range(len(self.records))])
        x = np.clip(np.asarray(given.layout.vector(params), float), given.lower, given.upper)
        return dataclasses.replace(given, x=x)

    def _stages(self) -> tuple[np.ndarray, ...]:
        """Masks of the residual for a growing share of each recording."""
        masks = []
        for share in SHARES:
            within = [r.times - r.t0 <= share * (r.times[-1] - r.t0) for r in self.records]
            each = zip(within, self.records, strict=True)
            masks.append(np.concatenate([np.repeat(mask, len(r.columns)) for mask, r in each]))
        counted = np.concatenate([r.seen[:, np.asarray(r.columns, int)].ravel() for r in self.records])
        kept: list[np.ndarray] = []
        for mask in masks:
            count = int((mask & counted).sum())
            if count > (int((kept[-1] & counted).sum()) if kept else 0) and count < counted.sum():
                kept.append(mask)
        return tuple(mask.astype(float) for mask in kept)

    def _known(self, problem: Problem) -> Known:
        """Variance and noise of the data, weighted as the residuals are."""
        variance, squares, count, first = 0.0, 0.0, 0, 0
        for r in self.records:
            columns = np.asarray(r.columns, int)
            flat = np.where(r.seen, r.flat, np.nan)[:, columns]
            weight = np.asarray(problem.weights, float)[first : first + flat.size].reshape(flat.shape)
            first += flat.size
            variance += variance_of(flat, weight) or 0.0
            noise = noise_of(r.times, flat, weight)
            if noise is not None:
                squares, count = squares + noise**2 * flat.size, count + flat.size
        more = sum(int((r.left_out[:, None] & np.isfinite(r.flat)).sum()) for r in self.records)
        words = (f"{more} values are left out that the largest delay would put before the run",) if more else ()
        return Known(variance or None, float(np.sqrt(squares / count)) if count else None, words)

    def _scale(self) -> dict[str, Any]:
        """A sensible step of each parameter, for an optax optimiser."""
        return {name: jax.tree.map(size_of, x) for name, x in self.start.items()}

    def states(self, params: dict[str, Any]) -> list[ParticleState]:
        """The initial states with the fitted parameters, one a recording."""
        return [self._put(k, params)[1] for k in range(len(self.records))]

    def _put(self, k: int, params: dict[str, Any]) -> tuple[Scene, ParticleState]:
        mine = {n: jax.tree.map(lambda x: x[k], v) if n in self.residual.own else v for n, v in params.items()}
        return self.residual.places.put(self.records[k].scene, self.records[k].state, mine)

    def predicted(self, params: dict[str, Any]) -> list[Any]:
        """The readings at the times of each recording, (time, ...)."""
        method = self.residual.readings if self.traced else compiled_readings(self.residual)
        read = method(params, self.data())
        found: dict[int, Any] = {}
        for group, values in zip(self.residual.groups, read, strict=True):
            for k, member in enumerate(group.members):
                found[member] = values[k, : group.lengths[k]]
        return [found[k] for k in range(len(self.records))]

    def _off(self, predicted: Sequence[Any]) -> np.ndarray:
        """The residual of readings."""
        parts = []
        for k, (r, read) in enumerate(zip(self.records, predicted, strict=True)):
            columns = np.asarray(r.columns, int)
            off = (np.asarray(read, float).reshape(len(r.times), -1) - np.where(r.seen, r.flat, 0))[:, columns]
            group = next(g for g, own in enumerate(self.residual.groups) if k in own.members)
            period = self.residual.periods[group]
            off = off if period is None else off - period * np.round(off / period)
            parts.append(np.where(r.seen[:, columns], off, 0).ravel())
        return np.concatenate(parts)

    def seen_whole(self, values: Any) -> Several:
        """The same with what was held out, to be shown."""
        each = [values] if self.single else values
        whole = (np.asarray(y, float).reshape(r.targets.shape) for r, y in zip(self.records, each, strict=True))
        records = (dataclasses.replace(r, targets=y) for r, y in zip(self.records, whole, strict=True))
        return dataclasses.replace(self, records=tuple(records))

    def series_of_each(self, predicted: Any) -> list[Columns]:
        """Times, measured and predicted columns of each recording; angles by the nearest turn."""
        each, parts = [predicted] if self.single else predicted, []
        for r, read in zip(self.records, each, strict=True):
            observed, shown = np.asarray(r.flat, float), np.asarray(read, float).reshape(len(r.times), -1)
            period = period_of(r.sensor)
            shown = shown if period is None else shown - period * np.round((shown - observed) / period)
            parts.append((r.times, observed, shown))
        return parts

    def series(self, predicted: Any) -> list[Series]:
        """What was measured beside what was predicted, one for each kind of sensor: its recordings in line."""
        kinds: dict[tuple[str, str, tuple[str, ...]], list[int]] = {}
        for k, record in enumerate(self.records):
            kinds.setdefault(record.shown_as("gain" in self.residual.of_sensor), []).append(k)
        parts = self.series_of_each(predicted)
        return [
            Series(
                *one_after_another([parts[k] for k in members]),
                list(names),
                quantity,
                unit,
                [self.records[k].num_steps for k in members],
                tuple(members),
            )
            for (quantity, unit, names), members in kinds.items()
        ]

    def completed(self, outcome: Outcome, step_bias: bool) -> tuple[dict[str, Any], Any, Scene, Any, Any]:
        """What a `SpringFit` has beside the `Fit`: the bias of the step, scene, states and predictions."""
        found = outcome.fit
        fields = {field.name: getattr(found, field.name) for field in dataclasses.fields(found)}
        scene, _ = self.residual.places.put(self.scene, self.records[0].state, self._first(found))
        states, predicted, bias = tuple(self.states(found.params)), tuple(self.predicted(found.params)), None
        if step_bias and any(draws(effect, self.key) for effect in scene.effects):
            fields["message"] = "; ".join([fields["message"], RANDOM])
        elif step_bias and found.covariance is not None and outcome.state is not None:
            whole = self._off(predicted)
            bias, more = shifted(whole, self._in_halves(found), self.dt, self.residual.step, found, outcome.state)
            fields["message"] = "; ".join([fields["message"], *more])
        elif step_bias and attached(found, ASKED) is not None:
            fields["message"] = "; ".join([fields["message"], UNKNOWN])
        if self.single:
            return fields, bias, scene, states[0], predicted[0]
        return fields, bias, scene, states, predicted

    def _first(self, found: Fit) -> dict[str, Any]:
        return {n: jax.tree.map(lambda x: x[0], v) if n in self.residual.own else v for n, v in found.params.items()}

    def _in_halves(self, found: Fit) -> np.ndarray:
        """The residual in steps of dt / 2."""
        groups = tuple(dataclasses.replace(g, num_steps=2 * g.num_steps) for g in self.residual.groups)
        finer = dataclasses.replace(self.residual, groups=groups)
        leaves = compiled_residual(finer)(found.params, self.data(2))
        return np.concatenate([np.ravel(np.asarray(leaf, float)) for leaf in leaves])
