"""diagnose names the step, the part, the particle and the cause of each kind of loss."""

import jax
import jax.numpy as jnp
import pytest

import jeuler
from jeuler.diagnosis._diagnose import diagnose
from jeuler.steps.implicit import implicit_euler_step

SPRING = jeuler.Scene(forces=(jeuler.Springs([[1, 2]], ks=100.0, kd=1.0, rest_length=1.0),))
STRETCHED = jeuler.ParticleState(jnp.array([[0.0], [0.0], [1.1]]), jnp.zeros((3, 1)))
COINCIDENT = jeuler.ParticleState(jnp.array([[0.0, 0.0], [0.0, 0.0], [1.0, 1.0]]), jnp.zeros((3, 2)))
GRAVITY = jeuler.Scene(forces=(jeuler.Gravity([0.0, -1.0]),))


def test_finite_run():
    found = diagnose(SPRING, STRETCHED, dt=1e-3, num_steps=50, loss=lambda s: jnp.sum(s.position**2))
    assert found.finite
    assert "finite" in str(found)


def test_step_over_the_stability_limit_says_by_what_factor():
    """mu = 1/2: omega = sqrt(200), explicit limit kd / ks = 0.01 s."""
    found = diagnose(SPRING, STRETCHED, dt=0.5, num_steps=1000)
    run = jeuler.simulate(SPRING, STRETCHED, dt=0.5, num_steps=1000)
    assert found.step == int(run.first_nonfinite) > 1
    assert found.part == "forces[0] Springs"
    assert found.particles == (1, 2)
    assert found.springs == (0,)
    assert "50 times the stability limit 0.01 s of euler_step" in found.cause
    assert "implicit_euler_step" in found.remedy


def test_no_stable_step_for_an_undamped_spring_under_explicit_euler():
    undamped = jeuler.Scene(forces=(jeuler.Springs([[1, 2]], ks=100.0, kd=0.0, rest_length=1.0),))
    found = diagnose(undamped, STRETCHED, dt=0.5, num_steps=1000)
    assert "no dt is stable" in found.cause
    assert "symplectic_euler_step" in found.remedy


def direction_to_first(t, position, velocity, mass):
    d = position[0] - position
    return d / jnp.linalg.norm(d, axis=-1, keepdims=True)


def test_coincident_pair_in_a_force():
    scene = jeuler.Scene((jeuler.Gravity([0.0, -1.0]), direction_to_first))
    found = diagnose(scene, COINCIDENT, dt=0.1, num_steps=3)
    assert (found.step, found.part, found.particles) == (1, "forces[1] direction_to_first", (0, 1))
    assert "particles 0 and 1 coincide" in found.cause


def pull_with_a_root(t, position, velocity, mass):
    return -position * jnp.sqrt(jnp.sum(position**2, axis=-1, keepdims=True))


def test_gradient_lost_in_a_force_whose_value_is_finite():
    scene = jeuler.Scene((pull_with_a_root,))
    found = diagnose(scene, COINCIDENT, dt=0.1, num_steps=3, loss=lambda s: jnp.sum(s.position**2))
    assert not found.finite
    assert (found.quantity, found.step, found.part) == ("gradient", 3, "forces[0] pull_with_a_root")
    assert found.particles == (0, 1)
    assert "derivative" in found.cause


def test_gradient_lost_in_the_loss():
    def distance(state):
        return jnp.linalg.norm(state.position[0] - state.position[1])

    found = diagnose(GRAVITY, COINCIDENT, dt=0.1, num_steps=3, loss=distance)
    assert (found.quantity, found.part, found.particles) == ("gradient", "loss", (0, 1))


def test_nan_in_the_initial_state_and_in_a_parameter():
    state = jeuler.ParticleState([[0.0, 0.0], [jnp.nan, 1.0]], [[0.0, 0.0], [0.0, 1.0]])
    found = diagnose(GRAVITY, state, dt=0.1, num_steps=3)
    assert (found.step, found.part, found.particles) == (0, "state.position", (1,))
    found = diagnose(jeuler.Scene((jeuler.Gravity([0.0, jnp.inf]),)), COINCIDENT, dt=0.1, num_steps=3)
    assert (found.step, found.part) == (0, "scene.forces[0].acceleration")


def test_tiny_mass_overflows_in_float32_only():
    mass = jnp.array([1.0, 1e-38, 1.0], jnp.float32)
    single = jeuler.ParticleState(STRETCHED.position.astype("float32"), jnp.zeros((3, 1), "float32"), mass)
    found = diagnose(SPRING, single, dt=0.1, num_steps=1)
    assert (found.step, found.part, found.particles) == (1, "acceleration", (1,))
    assert "float32" in found.cause


def test_effect_that_divides_by_zero_and_the_key_of_its_step():
    def lottery(t, dt, state, key):
        bad = jax.random.uniform(key) < 0.1
        factor = jnp.where(bad, jnp.nan, 1.0)
        return jeuler.ParticleState(state.position.at[2].multiply(factor), state.velocity, state.mass)

    scene, key = jeuler.Scene(GRAVITY.forces, (lottery,)), jax.random.key(3)
    run = jeuler.simulate(scene, COINCIDENT, dt=0.1, num_steps=60, key=key)
    found = diagnose(scene, COINCIDENT, dt=0.1, num_steps=60, key=key)
    assert found.step == int(run.first_nonfinite) > 1
    assert (found.part, found.particles) == ("effects[0] lottery", (2,))


def test_implicit_step_that_does_not_converge():
    explosion = jeuler.Scene((lambda t, x, v, m: 1e3 * jnp.exp(x),))
    found = diagnose(explosion, STRETCHED, dt=0.5, num_steps=5, step=implicit_euler_step)
    assert (found.step, found.part) == (1, "implicit_euler_step")
    assert "not solved" in found.cause


def test_exploding_cotangent():
    """y -> 1e30 y a step: the value, from 0, stays 0; its derivative overflows."""
    scene = jeuler.Scene((lambda t, x, v, m: 1e60 * x,))
    rest = jeuler.ParticleState(jnp.zeros((1, 1)), jnp.zeros((1, 1)))
    found = diagnose(scene, rest, dt=1.0, num_steps=20, loss=lambda s: jnp.sum(s.position))
    assert found.quantity == "gradient"
    assert "grew" in found.cause
    assert "cap_cotangent" in found.remedy


def test_bad_input_is_refused_as_in_simulate():
    with pytest.raises(ValueError, match="dt"):
        diagnose(SPRING, STRETCHED, dt=0.0, num_steps=5)


def test_a_pool_of_dead_slots_and_an_emitter_that_never_stops_are_no_loss():
    """`Emitter.stop` is inf, a dead slot lies at the origin, where this force is NaN: neither is a fault."""

    def to_the_origin(t, position, velocity, mass):
        return -position / jnp.linalg.norm(position, axis=-1, keepdims=True)

    jet = jeuler.Emitter(20.0, position=[1.0, 0.0], velocity=[0.0, 1.0])
    scene = jeuler.Scene((jeuler.Gravity([0.0, -1.0]), to_the_origin), (jet,))
    run = {"dt": 0.1, "num_steps": 6, "key": jax.random.key(0)}
    pool = jeuler.empty_pool(8, dim=2)
    assert jeuler.simulate(scene, pool, **run).first_nonfinite == -1
    assert diagnose(scene, pool, **run).finite


def test_newborn_at_the_place_of_another_is_named_with_the_step_of_its_birth():
    def repel(t, position, velocity, mass, alive):
        d = position[:, None] - position[None]
        apart = jnp.linalg.norm(d, axis=-1, keepdims=True)
        both = alive[:, None, None] & alive[None, :, None] & ~jnp.eye(len(position), dtype=bool)[..., None]
        return jnp.sum(jnp.where(both, d / apart, 0), axis=1)

    repel = jeuler.uses(reads=("alive",))(repel)
    jet = jeuler.Emitter(0.0, position=[1.0, 0.0], velocity=[0.0, 0.0], bursts=((0.2, 2),))
    scene, run = jeuler.Scene((repel,), (jet,)), {"dt": 0.1, "num_steps": 6, "key": jax.random.key(0)}
    pool = jeuler.empty_pool(4, dim=2)
    found = diagnose(scene, pool, **run)
    assert found.step == int(jeuler.simulate(scene, pool, **run).first_nonfinite) == 3
    assert (found.part, found.particles) == ("forces[0] repel", (0, 1))
    assert "particles 0 and 1 coincide" in found.cause


def test_field_that_a_force_reads_and_an_effect_spoils():
    """The force is NaN in step 4, for an effect of step 3 made the temperature negative."""

    @jeuler.uses(reads=("temperature",))
    def lift(t, position, velocity, mass, temperature):
        return jnp.sqrt(temperature)[:, None] * jnp.ones_like(position)

    @jeuler.uses(writes=("temperature",))
    def cool(t, dt, state, key):
        return state.replace(temperature=state.temperature - 0.4)

    state = COINCIDENT.replace(temperature=jnp.array([1.0, 5.0, 5.0]))
    found = diagnose(jeuler.Scene((lift,), (cool,)), state, dt=0.1, num_steps=6)
    assert (found.step, found.part, found.particles) == (4, "forces[0] lift", (0,))


def test_drag_is_replayed_as_simulate_runs_it():
    """An explicit drag at 1000 times its limit does not overshoot in `simulate`, nor in the search for its gradient."""
    scene = jeuler.Scene((jeuler.LinearDrag(1e4),))
    moving = jeuler.ParticleState([[0.0, 0.0]], [[1.0, 2.0]])
    found = diagnose(scene, moving, dt=0.1, num_steps=100, loss=lambda s: jnp.sum(s.position**2))
    assert found.finite


# --- the cause where a hook changes the forces ------------------------------------------------------------------------


def lost(scene, state, **run):
    """The diagnosis, of the step in which `simulate` was lost."""
    found = diagnose(scene, state, **run)
    assert found.step == int(jeuler.simulate(scene, state, **run).first_nonfinite) > 1
    return found


def test_a_limited_drag_is_not_blamed_for_what_an_effect_does():
    """c dt / m = 5: plain, the drag would be over its limit of 0.04 s."""

    def scatter(t, dt, state, key):
        return state.replace(position=1e40 * state.position)

    scene = jeuler.Scene((jeuler.Gravity([0.0, -1.0]), jeuler.LinearDrag(50.0)), (scatter,))
    found = lost(scene, COINCIDENT, dt=0.1, num_steps=20)
    assert found.part == "effects[0] scatter"
    assert "the numbers grew" in found.cause
    assert "stability" not in found.cause


def test_springs_beside_a_limited_drag_have_the_limit_of_that_step():
    """v' = v - (ks x + c v) dt / (c dt) makes x' = (1 - ks dt / c) x, stable below 2 c / ks = 1 s; c dt / m = 15."""
    scene = jeuler.Scene((jeuler.Springs([[0, 1]], ks=20.0, kd=0.0, rest_length=0.0), jeuler.LinearDrag(10.0)))
    state = jeuler.ParticleState([[0.0], [1.1]], jnp.zeros((2, 1)), mass=[jnp.inf, 1.0])
    step = jeuler.symplectic_euler_step
    assert "1.5 times the stability limit 1 s" in lost(scene, state, dt=1.5, num_steps=2000, step=step).cause
    run = jeuler.simulate(scene, state, dt=0.99, num_steps=400, step=step)
    assert abs(run.y.position[-1, 1, 0]) < 0.01


def test_a_pool_that_is_empty_at_the_start_has_the_limit_of_those_born_later():
    def hold(t, position, velocity, mass):
        return -1000 * position

    scene = jeuler.Scene((hold,), (jeuler.Emitter(0.0, [1.0], [0.0], bursts=((0.5, 1),)),))
    run = {"dt": 0.1, "num_steps": 800, "step": jeuler.symplectic_euler_step, "key": jax.random.key(0)}
    found = lost(scene, jeuler.empty_pool(2, dim=1), **run)
    assert "1.58 times the stability limit 0.0632 s" in found.cause


def test_a_prescribed_path_that_ends_is_named_and_not_the_springs_on_it():
    path = jeuler.PrescribedMotion([0], lambda t: jnp.sqrt(0.35 - t) * jnp.ones((1, 1)))
    found = lost(jeuler.Scene(SPRING.forces, (path,)), STRETCHED, dt=0.1, num_steps=8)
    assert (found.step, found.part) == (4, "effects[0] PrescribedMotion")
    assert "prescribes is not finite at t = 0.4 s" in found.cause


def test_a_force_that_is_lost_within_a_step_is_named():
    def fades(t, position, velocity, mass):
        return jnp.sqrt(0.25 - t) * jnp.ones_like(position)

    found = lost(jeuler.Scene((fades,)), STRETCHED, dt=0.1, num_steps=5, step=jeuler.rk4_step)
    assert (found.step, found.part) == (3, "forces[0] fades")


def test_a_field_that_an_effect_left_as_nan_is_named_with_the_effect():
    @jeuler.uses(reads=("heat",))
    def rise(t, position, velocity, mass, heat):
        return heat[:, None] * jnp.ones_like(position)

    @jeuler.uses(writes=("heat",))
    def cool(t, dt, state, key):
        return state.replace(heat=jnp.sqrt(0.25 - t) * jnp.ones_like(state.heat))

    found = lost(jeuler.Scene((rise,), (cool,)), STRETCHED.replace(heat=jnp.ones(3)), dt=0.1, num_steps=6)
    assert (found.step, found.part) == (4, "forces[0] rise")
    assert "the field 'heat', which it reads, is NaN, as cool left it" in found.cause
