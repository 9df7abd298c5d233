"""fit_springs with observe= and recordings=: any sensor, late, scaled and shifted, and several records in one fit."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jeuler
from jeuler import observing
from jeuler.fitting.pages import page_of

KS, KD = 30.0, 0.4
SCENE = jeuler.Scene((jeuler.Springs([[0, 1]], ks=20.0, kd=0.1, rest_length=1.0),))
STATE = jeuler.ParticleState([[0.0], [1.2]], jnp.zeros((2, 1)), mass=[jnp.inf, 1.0])


def swing(t, from_rest=0.2):
    """Elongation, velocity and acceleration of a damped swing of 1 kg on KS, KD."""
    g = KD / 2
    w = np.sqrt(KS - g * g)
    decay = from_rest * np.exp(-g * t)
    x, v = decay * (np.cos(w * t) + g / w * np.sin(w * t)), -decay * KS / w * np.sin(w * t)
    return x, v, -KS * x - KD * v


def test_a_late_scaled_shifted_sensor_with_gaps_gives_its_own_numbers_and_the_springs(random):
    """reading = 2 x(t - 0.043) - 0.3, in irregular times, a fifth of it missing, in float32 of the state."""
    t = np.sort(random.uniform(0, 4, 300))
    reading = 2 * (1 + swing(t - 0.043)[0]) - 0.3 + 1e-3 * random.normal(size=t.shape)
    reading[random.uniform(size=t.shape) < 0.2] = np.nan
    names = ("ks", "kd", "delay", "gain", "bias")
    options = {"dt": 0.02, "parameters": names, "bounds": {"delay": (0.0, 0.2)}, "sigma": 1e-3}
    found = jeuler.fit_springs(SCENE, STATE, t, reading, observe=observing.Position([1]), **options)
    truth = {"ks": KS, "kd": KD, "delay": 0.043, "gain": 2.0, "bias": -0.3}
    for name in names:
        assert abs(found.params[name] - truth[name]) < 4 * found.stderr[name] < 0.02 * abs(truth[name]), name
    assert found.converged
    assert found.predicted.shape == (300, 1, 1)
    assert 0.8 < found.noise_ratio < 1.2
    early = np.isfinite(reading[t < 0.2]).sum()
    assert f"{early} values are left out that the largest delay would put before the run" in found.message
    np.testing.assert_allclose(
        float(found.log_density(found.params)), -0.5 * found.loss * np.isfinite(reading[t >= 0.2]).sum()
    )


def test_recordings_of_different_sensors_lengths_and_rates_share_the_spring(random):
    """A camera at 30 Hz for 3 s and at 25 Hz for 5 s, and an accelerometer at 200 Hz for 1 s: three own starts."""
    recordings, noise = [], (1e-3, 1e-3, 0.05)
    for (rate, span, start), own, what in zip(
        ((30, 3, 0.2), (25, 5, -0.1), (200, 1, 0.3)), noise, (0, 0, 2), strict=True
    ):
        t = np.arange(rate * span) / rate
        values = swing(t, start)[what] + (1.0 if what == 0 else 0.0) + own * random.normal(size=t.shape)
        observe = observing.Position([1]) if what == 0 else observing.Acceleration([1])
        state = jeuler.ParticleState([[0.0], [1.0 + start]], jnp.zeros((2, 1)), mass=[jnp.inf, 1.0])
        recordings.append(jeuler.Recording(t, values, observe=observe, sigma=own, state=state))
    names = ("ks", "kd", "velocity", "position")
    found = jeuler.fit_springs(SCENE, None, recordings=recordings, dt=0.02, parameters=names, held_out=0.2)
    assert abs(found.ks - KS) < 4 * found.stderr["ks"] < 0.1
    assert abs(found.kd - KD) < 4 * found.stderr["kd"] < 0.05
    assert found.params["velocity"].shape == found.params["position"].shape == (3, 1, 1)
    np.testing.assert_allclose(found.params["position"][:, 0, 0], [1.2, 0.9, 1.3], atol=3e-3)
    assert [read.shape for read in found.predicted] == [(90, 1, 1), (125, 1, 1), (200, 1, 1)]
    assert len(found.state) == 3
    assert found.training_rms == pytest.approx(found.held_out_rms, rel=0.5)
    assert "held out" not in found.message
    shown = page_of(found).shown  # unlike sensors share no axis of the report
    assert [(each.quantity, each.unit, list(each.names), each.whose) for each in shown] == [
        ("position", "m", ["x1"], "recordings 1, 2"),
        ("acceleration", "m/s^2", ["ax1"], "recording 3"),
    ]
    np.testing.assert_array_equal(shown[1].observed[:, 0], np.ravel(recordings[2].values))


def test_recordings_with_measured_inputs_of_their_own_give_spring_and_gain(random):
    """A shaker at 2 rad/s for 4 s and at 8 rad/s for 3 s, from rest: x'' = -ks x - kd x' + 2.5 u, by its closed form."""
    recordings = []
    for rate, span in ((2.0, 4.0), (8.0, 3.0)):
        t = np.arange(0.0, span + 1e-9, 0.05)
        amplitude = 2.5 / (KS - rate**2 + 1j * rate * KD)  # of the steady motion to u = cos(rate t)
        g = KD / 2
        w = np.sqrt(KS - g * g)
        x0, v0 = -amplitude.real, -(1j * rate * amplitude).real
        x = (
            np.exp(-g * t) * (x0 * np.cos(w * t) + (v0 + g * x0) / w * np.sin(w * t))
            + (amplitude * np.exp(1j * rate * t)).real
        )
        shaker = jeuler.AppliedForce(jeuler.SampledPath.band_limited(t, np.cos(rate * t)[:, None]), particles=[1])
        scene = jeuler.Scene((SCENE.forces[0], shaker))
        recordings.append(jeuler.Recording(t, 1 + x + 1e-4 * random.normal(size=t.shape), scene=scene))
    state = jeuler.ParticleState([[0.0], [1.0]], jnp.zeros((2, 1)), mass=[jnp.inf, 1.0])
    options = {"observe": observing.Position([1]), "dt": 0.02, "parameters": ("ks", "kd", "gain of the shaker")}
    with pytest.raises(ValueError, match="parameters must be among"):
        jeuler.fit_springs(recordings[0].scene, state, recordings=recordings, **options)
    options["parameters"] = ("ks", "kd", "forces[1].gain")
    found = jeuler.fit_springs(recordings[0].scene, state, recordings=recordings, **options)
    np.testing.assert_allclose([found.ks, found.kd, found.params["forces[1].gain"]], [KS, KD, 2.5], rtol=5e-3)
    assert found.explained > 0.99999


def test_a_moving_support_that_was_measured_gives_the_spring_that_hangs_on_it(random):
    """The support moves as 0.05 cos(4 t), measured 25 times a second: x'' = -ks (x - s) - kd (x' - s'), from rest."""
    rate, t = 4.0, np.arange(0.0, 4.0 + 1e-9, 0.04)
    amplitude = 0.05 * (KS + 1j * rate * KD) / (KS - rate**2 + 1j * rate * KD)  # of the steady motion
    g = KD / 2
    w = np.sqrt(KS - g * g)
    x0, v0 = -amplitude.real, -(1j * rate * amplitude).real
    x = np.exp(-g * t) * (x0 * np.cos(w * t) + (v0 + g * x0) / w * np.sin(w * t))
    x = x + (amplitude * np.exp(1j * rate * t)).real
    support = 0.05 * np.cos(rate * t)
    hand = jeuler.PrescribedMotion([0], jeuler.SampledPath.band_limited(t, support[:, None, None]))
    scene = jeuler.Scene(SCENE.forces, (hand,))
    state = jeuler.ParticleState([[0.05], [1.0]], jnp.zeros((2, 1)), mass=[jnp.inf, 1.0])
    reading = 1 + x + 1e-4 * random.normal(size=t.shape)
    options = {"observe": observing.Position([1]), "dt": 0.02, "parameters": ("ks", "kd"), "sigma": 1e-4}
    found = jeuler.fit_springs(scene, state, t, reading, **options)
    np.testing.assert_allclose([found.ks, found.kd], [KS, KD], rtol=5e-3)
    assert found.noise_ratio < 1.2


def test_angles_are_compared_up_to_full_turns():
    """A pendulum that goes over the top twice, its angle unwrapped, on a stiff spring."""
    state = jeuler.ParticleState([[0.0, 0.0], [0.0, -1.02]], [[0.0, 0.0], [7.0, 0.0]], mass=[jnp.inf, 1.0])

    def scene(ks):
        return jeuler.Scene((jeuler.Springs([[0, 1]], ks, 1.0, 1.0), jeuler.Gravity([0.0, -9.81])))

    run = jeuler.simulate(scene(300.0), state, dt=0.002, num_steps=1000, step=jeuler.rk4_step, save_every=20)
    p = np.asarray(run.y.position)[:, 1]
    angle = np.unwrap(np.arctan2(p[:, 0], -p[:, 1]))
    assert angle.max() > 2 * np.pi
    found = jeuler.fit_springs(
        scene(200.0), state, np.asarray(run.t), angle, dt=0.01, observe=observing.Angle([0, 1]), parameters=("ks",)
    )
    assert abs(found.ks - 300) < 1


def test_a_traced_record_is_fitted_as_part_of_a_program():
    t = np.linspace(0, 2, 41)
    records = jnp.stack([1 + swing(t)[0], 1 + 0.5 * swing(t)[0]])

    def ks(record):
        options = {"observe": observing.Distance([0, 1]), "parameters": ("ks", "position"), "grow": False}
        return jeuler.fit_springs(SCENE, STATE, t, record, dt=0.05, **options).ks

    np.testing.assert_allclose(jax.jit(jax.vmap(ks))(records), KS, rtol=2e-2)


T = np.linspace(0.0, 1.0, 11)
WRONG = {
    "observation": ({"observe": "speed"}, "observe must be 'position', 'velocity', 'acceleration'"),
    "no array": ({"observe": lambda scene, state: scene.nothing}, "observe must be a function .* it fails"),
    "shape": ({"observe": observing.Velocity([1]), "positions": np.zeros((11, 2, 1))}, r"positions must have shape .* = \(11, 1, 1\)"),
    "steps": ({"observe": "velocity", "num_steps": 50}, "num_steps is for positions alone"),
    "delay": ({"parameters": ("delay",), "bounds": {"delay": (0.1, 0.2)}}, "a delay must start between its bounds"),
    "delay of the whole": ({"parameters": ("delay",), "bounds": {"delay": (0, 2.0)}}, "times must reach beyond the largest"),
    "bounds of a delay": ({"parameters": ("delay",), "bounds": {"delay": 0.1}}, "must be a pair of two finite times"),
    "both": ({"recordings": [jeuler.Recording(T, np.zeros(11))]}, "times and positions must be left out with recordings"),
    "none": ({"recordings": [], "times": None, "positions": None}, "recordings must be a list of jeuler.Recording"),
    "no recording": ({"recordings": [(T, T)], "times": None, "positions": None}, "each of recordings must be a Recording"),
    "strangers": (
        {"recordings": [jeuler.Recording(T, T, scene=jeuler.Scene())], "times": None, "positions": None, "observe": observing.Position([1])},
        r"recordings\[0\].scene must have the forces and effects",
    ),
    "own": (
        {"recordings": [jeuler.Recording(T, T)], "times": None, "positions": None, "observe": observing.Position([1]), "per_recording": ("mass",)},
        "per_recording must be among parameters",
    ),
    "some sigma": (
        {"recordings": [jeuler.Recording(T, T, sigma=0.1), jeuler.Recording(T, T)], "times": None, "positions": None, "observe": observing.Position([1])},
        "sigma must be given for all recordings or for none",
    ),
    "held out": ({"held_out": 1.0}, "held_out must be a share of the span"),
    "all held out": ({"held_out": np.ones(11, bool)}, "held_out must leave times to fit"),
    "ties": ({"ties": {"ks": [1, 1]}}, r"ties\['ks'\] must have one label for each of the 1 numbers"),
    "ties of what is not fitted": ({"ties": {"mass": [1, 1]}}, "ties must name parameters"),
    "smoothness of one number": ({"smoothness": {"ks": 1.0}}, "one number for each spring"),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_question_is_told_in_one_line(name):
    given, words = WRONG[name]
    values = np.stack([0 * T, 1 + swing(T)[0]], axis=1)[:, :, None]
    arguments = {"scene": SCENE, "state": STATE, "times": T, "positions": values, "dt": 0.05} | given
    with pytest.raises(ValueError, match=words):
        jeuler.fit_springs(**arguments)
