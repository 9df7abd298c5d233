"""A recording with a scene: the fit of one to the other, from checked input to what it is worth."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jeuler._core import checks
from jeuler.fitting.asked import ASKED
from jeuler.fitting.beside import attached
from jeuler.fitting.engine import Outcome, run
from jeuler.fitting.forward import Forward
from jeuler.fitting.mismatch import mismatched
from jeuler.fitting.observations import (
    amplitude_of,
    checked_observations,
    horizons,
    noise_of,
    speed_of,
    variance_of,
)
from jeuler.fitting.options import Known, Options
from jeuler.fitting.parameters import Places
from jeuler.fitting.prediction import Prediction, compiled_positions, recording
from jeuler.fitting.priors import Alike
from jeuler.fitting.problem import Problem
from jeuler.fitting.sampling import aliased
from jeuler.fitting.series import Columns, Series, column_names
from jeuler.fitting.smoothness import alike_neighbours
from jeuler.fitting.step_bias import RANDOM, bias_of_many, bias_of_step
from jeuler.fitting.two_starts import from_both
from jeuler.fitting.unknowns import Layout, size_of
from jeuler.fitting.weak_form import weak_form
from jeuler.fitting.windows import in_windows
from jeuler.particles.fields import draws
from jeuler.particles.scene import Scene
from jeuler.particles.state import ParticleState
from jeuler.solving.grid import Checkpoint
from jeuler.steps.explicit import Step

POOR = 0.9  # share explained below which units and origins are looked at


@dataclasses.dataclass(frozen=True)
class Recorded:
    """A scene, a recording of it, and what is free."""

    scene: Scene
    state: ParticleState
    times: np.ndarray
    targets: Any
    t0: float
    dt: float
    prediction: Prediction
    start: dict[str, Any]
    key: Any = None

    @classmethod
    def of(
        cls,
        scene: Scene,
        state: ParticleState,
        times: Any,
        positions: Any,
        *,
        dt: Any,
        t0: Any,
        num_steps: Any,
        step: Step,
        names: Any,
        where: Any,
        ties: Any = None,
        key: Any = None,
        checkpoint: Checkpoint = None,
    ) -> Recorded:
        """Checked, or one ValueError."""
        checks.kind("scene", scene, Scene)
        checks.kind("state", state, ParticleState)
        state.check()
        scene.check(state)
        checks.positive("dt", dt, "s")
        checks.number("t0", t0)
        for name, value in (("dt", dt), ("t0", t0), ("times", times), ("state.mass", state.mass)):
            if checks.is_traced(value):
                raise ValueError(f"{name} must be a value, got a traced one; only positions and parameters are traced")
        times, targets = checked_observations(times, positions, state.position.shape, float(t0))
        if dt > times[-1] - t0 and times[-1] > t0:
            raise ValueError(
                f"dt must be at most the span of the times, {times[-1] - t0:g} s from t0={t0:g} s, got {dt:g} s; "
                f"dt is the step of the simulation, take one well below the period of the motion"
            )
        needed = max(1, int(np.ceil((times[-1] - t0) / dt * (1 - 1e-12))))
        num_steps = needed if num_steps is None else checks.count("num_steps", num_steps, least=1)
        if num_steps < needed:
            raise ValueError(
                f"times must lie in the simulated span, {t0} to {t0 + num_steps * dt} s, got {times[-1]}; "
                f"num_steps={needed} reaches it"
            )
        places = Places.of(state, names, where, ties, scene)
        flat = targets.reshape(len(times), -1)
        observed = np.arange(flat.shape[1]) if checks.is_traced(targets) else np.isfinite(flat).any(axis=0).nonzero()[0]
        prediction = Prediction(places, step, num_steps, tuple(observed.tolist()), checkpoint)
        return cls(scene, state, times, targets, float(t0), float(dt), prediction, places.read(scene, state), key)

    @property
    def data(self) -> dict[str, Any]:
        """The recording as the compiled programs take it."""
        return recording(
            self.scene,
            self.state,
            self.times,
            self.targets,
            self.prediction.columns,
            dt=self.dt,
            t0=self.t0,
            num_steps=self.prediction.num_steps,
            key=self.key,
        )

    @property
    def traced(self) -> bool:
        parts = (self.scene, self.state, self.targets, self.start)
        return any(map(checks.is_traced, jax.tree.leaves(parts)))

    def problem(
        self,
        start: dict[str, Any],
        bounds: Any,
        sigma: Any,
        weights: Any,
        stages: Any,
        priors: Any = None,
        loss: str = "linear",
        alike: Alike | None = None,
    ) -> Problem:
        """The least-squares problem from this start."""
        data = self.data
        columns = np.asarray(self.prediction.columns, int)

        def in_columns(name: str, x: Any) -> Any:
            try:
                x = jnp.broadcast_to(x, self.targets.shape) if checks.is_traced(x) else np.asarray(x, float)
                spread: Any = np.broadcast_to(x, self.targets.shape) if isinstance(x, np.ndarray) else x
            except (ValueError, TypeError):
                raise ValueError(
                    f"{name} must broadcast to positions, (time, particle, dim) = {self.targets.shape}, "
                    f"got shape {np.shape(x)}"
                ) from None
            return spread.reshape(len(self.times), -1)[:, columns]

        sigma, weights = (
            None if x is None else in_columns(name, x) for name, x in (("sigma", sigma), ("weights", weights))
        )
        observed = data["observed"]
        xp: Any = np if isinstance(observed, np.ndarray) else jnp
        if sigma is not None:
            sigma = xp.where(observed, sigma, np.inf)
        else:
            weights = xp.where(observed, 1.0 if weights is None else weights, 0.0)
        return Problem.of(
            self.prediction,
            start,
            data=data,
            bounds=self.prediction.places.bounds(self.scene, bounds),
            positive=self.prediction.places.positive(self.scene),
            sigma=sigma,
            weights=weights,
            stages=stages,
            priors=priors,
            loss=loss,
            alike=alike,
        )

    def fit(
        self,
        options: Options,
        bounds: Any,
        sigma: Any,
        weights: Any,
        start: str,
        grow: bool,
        priors: Any = None,
        smoothness: Any = None,
        window: int | None = None,
    ) -> tuple[Outcome, str]:
        """Search from the data and, where that is not good, from the scene's values; the better, and its start."""
        _refuse_stillness(self.targets)
        stages = self._stages() if grow and options.minibatch is None else ()
        alike = alike_neighbours(self.scene, self.prediction.places, smoothness)
        given = self.problem(self.start, bounds, sigma, weights, stages, priors, options.loss, alike)
        if options.minibatch is not None:
            given = dataclasses.replace(given, windows=in_windows(given, self, window))
        if self.traced:
            return run(given, options, scale=jax.tree.map(size_of, self.start)), "given"
        known, scale = self._known(given), self._scale()
        begun = self._from_data(given) if start == "data" else None
        return from_both(given, begun, options, scale, known)

    def _from_data(self, given: Problem) -> Problem | None:
        """The same problem from what the weak form finds in the positions."""
        found = weak_form(self.scene, self.state, self.times, self.targets, self.prediction.places, self.start)
        if found is None:
            return None
        x = np.clip(np.asarray(given.layout.vector(found.params), float), given.lower, given.upper)
        return dataclasses.replace(given, x=x)

    def _stages(self) -> tuple[np.ndarray, ...]:
        """Masks of the residual for a growing horizon."""
        observed = np.asarray(self.data["observed"]) if not checks.is_traced(self.targets) else None
        times = self.times - self.t0
        columns = len(self.prediction.columns)
        if observed is None:
            observed = np.ones((len(times), columns), bool)
        per_value = np.repeat(times, columns)[observed.ravel()]
        masks = horizons(per_value)
        ends = [per_value[mask > 0].max() for mask in masks]
        return tuple(np.repeat((times <= end).astype(float), columns) for end in ends)

    def _known(self, problem: Problem) -> Known:
        """Variance and noise of the data, weighted as the residuals are."""
        flat = self.targets.reshape(len(self.times), -1)[:, np.asarray(self.prediction.columns, int)]
        weight = np.asarray(problem.weights, float)[: flat.size].reshape(flat.shape)
        return Known(variance_of(flat, weight), noise_of(self.times, flat, weight))

    def _scale(self) -> dict[str, Any]:
        """A sensible step of each parameter, for an optax optimiser."""
        amplitude, speed = amplitude_of(self.targets), speed_of(self.times, self.targets)
        sizes = {"velocity": speed, "position": amplitude, "anchors": amplitude}
        return {name: sizes[name] if name in sizes else jax.tree.map(size_of, x) for name, x in self.start.items()}

    def seen_whole(self, values: Any) -> Recorded:
        """The same with what was held out, to be shown."""
        return dataclasses.replace(self, targets=np.asarray(values, float))

    def series_of_each(self, predicted: Any) -> list[Columns]:
        """Times, measured and predicted columns."""
        observed, shown = (np.asarray(y, float).reshape(len(self.times), -1) for y in (self.targets, predicted))
        return [(self.times, observed, shown)]

    def series(self, predicted: Any) -> list[Series]:
        """What was measured beside what was predicted: one kind of readings."""
        names = column_names("position", np.shape(self.targets)[1:], None)
        return [Series(*self.series_of_each(predicted)[0], names, "position", "m", [self.prediction.num_steps])]

    def completed(self, outcome: Outcome, step_bias: bool) -> tuple[dict[str, Any], Any, Scene, ParticleState, Array]:
        """What a `SpringFit` has beside the `Fit`: the bias of the step, scene, state and prediction."""
        found = outcome.fit
        fields = {field.name: getattr(found, field.name) for field in dataclasses.fields(found)}
        scene, state = self.prediction.places.put(self.scene, self.state, found.params)
        data, bias = self.data, None
        if self.traced:
            return fields, None, scene, state, self.prediction.positions(found.params, data)
        if outcome.state is None:  # no derivatives were compiled
            predicted = compiled_positions(self.prediction)(found.params, data)
        else:
            layout = Layout.of(found.params)
            forward = Forward.of(self.prediction, layout, data)
            predicted = jnp.asarray(forward.positions(layout.vector(found.params), data), self.state.position.dtype)
        words = aliased(self.scene, scene, state, self.times)
        if found.explained is not None and found.explained < POOR:
            words += mismatched(self.scene, self.state, self.times, self.targets, self.t0)
        if step_bias and any(draws(effect, self.key) for effect in scene.effects):
            words = [*words, RANDOM]
        elif step_bias and found.covariance is not None and outcome.state is not None:
            bias, more = bias_of_step(self, found, outcome.state)
            words = [*words, *more]
        elif step_bias and (asked := attached(found, ASKED)) is not None:
            bias, more = bias_of_many(self, found, asked)
            words = [*words, *more]
        fields["message"] = "; ".join([fields["message"], *words])
        return fields, bias, scene, state, predicted


def _refuse_stillness(targets: Any) -> None:
    """One ValueError for positions that never change: they say nothing."""
    if checks.is_traced(targets):
        return
    seen = np.isfinite(targets)
    first = np.where(seen, targets, 0)[np.argmax(seen, axis=0), *np.indices(seen.shape[1:])]
    if seen.any() and np.all(np.where(seen, targets, first) == first):
        raise ValueError("positions must move, got the same ones at all times; give a recording of a motion")
