"""The teaching figures show the numbers that they should."""

import jax.numpy as jnp
import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pytest

import jeuler
from jeuler.plotting import teaching

matplotlib.use("Agg")


def field(t, y, args):
    return t + y / 5


def exact(t):
    return 22 * np.exp(np.asarray(t) / 5) - 5 * np.asarray(t) - 25


@pytest.fixture(autouse=True)
def _close():
    yield
    plt.close("all")


def test_slope_field_draws_exact_curves_and_carried_on_ones():
    drawn = teaching.slope_field(field, (0, 5), (-4, 10), solutions={"exact": exact, "carried on": -3.0})
    given, carried = drawn.lines
    np.testing.assert_allclose(
        np.interp(carried.get_xdata(), given.get_xdata(), given.get_ydata()), carried.get_ydata(), atol=1e-3
    )
    (arrows,) = (c for c in drawn.collections if hasattr(c, "U"))
    slope = arrows.V / arrows.U * 14 / 5
    np.testing.assert_allclose(slope.ravel(), [x + y / 5 for x, y in arrows.get_offsets()], rtol=1e-6)
    assert {text.get_text() for text in drawn.texts} == {"exact", "carried on"}


def test_polygon_has_the_steps_as_corners():
    drawn = teaching.euler_polygon(field, -3.0, t0=0.0, t1=5.0, num_steps=5, exact=exact)
    np.testing.assert_allclose(drawn.lines[1].get_ydata(), [-3, -3.6, -3.32, -1.984, 0.6192, 4.74304])
    np.testing.assert_allclose(drawn.lines[0].get_ydata()[-1], exact(5.0))


def test_step_sizes_have_one_curve_each_beside_the_exact_one():
    drawn = teaching.step_sizes(field, -3.0, t0=0.0, t1=5.0, dts=[1.0, 0.2, 0.02], exact=exact)
    assert [len(line.get_xdata()) for line in drawn.lines[1:]] == [6, 26, 251]
    gaps = [abs(line.get_ydata()[-1] - exact(5.0)) for line in drawn.lines[1:]]
    assert gaps == sorted(gaps, reverse=True)


def test_local_error_is_that_of_one_step_from_the_exact_solution():
    drawn = teaching.local_and_cumulative_error(field, -3.0, t0=0.0, t1=5.0, num_steps=50, exact=exact)
    cumulative, local = (line.get_ydata() for line in drawn.lines)
    assert cumulative[0] == pytest.approx(local[0])
    t = 0.1 * np.arange(50)
    np.testing.assert_allclose(local, np.abs(exact(t) + 0.1 * (t + exact(t) / 5) - exact(t + 0.1)), rtol=1e-6)
    assert cumulative[-1] > 10 * local[-1]


@pytest.mark.optimised
def test_error_against_dt_turns_up_in_float32_and_not_with_compensated_sums():
    drawn = teaching.error_against_dt(
        lambda t, y, args: -y,
        1.0,
        t0=0.0,
        t1=1.0,
        num_steps=[2**k for k in range(6, 21, 2)],
        exact=lambda t: np.exp(-t),
    )
    plain, compensated = (line.get_ydata() for line in drawn.lines[:2])
    assert plain[-1] > min(plain)
    assert compensated[-1] == min(compensated)


def test_stability_regions_have_their_extent_and_the_eigenvalues_on_top():
    drawn = teaching.stability_regions(
        {"Euler": jeuler.euler_step, "RK4": jeuler.rk4_step}, eigenvalues=[-1 + 2j, -1 - 2j], dt=0.5
    )
    dots = drawn.lines[-1]
    np.testing.assert_allclose(dots.get_xdata() + 1j * dots.get_ydata(), [-0.5 + 1j, -0.5 - 1j])
    borders = [c for c in drawn.collections if len(c.get_paths()) and c.get_linewidth().size and len(c.get_edgecolor())]
    left = [min(path.vertices[:, 0].min() for path in c.get_paths() if len(path.vertices)) for c in borders]
    assert min(left) == pytest.approx(-2.785, abs=0.02)
    assert any(x == pytest.approx(-2.0, abs=0.02) for x in left)
    assert jnp.ones(1).dtype == jnp.float64


def test_a_tangent_leaves_its_curve_by_the_local_error():
    drawn = teaching.tangent_step(field, t0=1.0, dt=2.0, exact=exact)
    end = exact(1.0) + 2 * (1 + exact(1.0) / 5)
    np.testing.assert_allclose(drawn.lines[1].get_ydata(), [exact(1.0), end], rtol=1e-6)
    np.testing.assert_allclose(drawn.lines[2].get_ydata(), [end, exact(3.0)], rtol=1e-6)


def test_the_polygon_goes_from_curve_to_neighbouring_curve():
    """Each curve is a solution, y + 5 t + 25 = c exp(t / 5), and has its corner on it."""
    *curves, polygon = teaching.neighbouring_curves(field, -3.0, t0=0.0, t1=5.0, num_steps=3).lines
    constants = [(c.get_ydata() + 5 * c.get_xdata() + 25) / np.exp(c.get_xdata() / 5) for c in curves]
    assert len(curves) == 4
    for constant, x, y in zip(constants, *polygon.get_data(), strict=True):
        np.testing.assert_allclose(constant, (y + 5 * x + 25) / np.exp(x / 5), rtol=1e-6)
    assert np.all(np.diff([constant[0] for constant in constants]) < 0), "each step falls to a lower curve"
    assert {text.get_text() for text in polygon.axes.texts} == {"exact", "steps"}
