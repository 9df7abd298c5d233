"""A fit as one page: what it shows, that it fetches nothing, and that it is whole or not there."""

import html.parser
import os
import re
import shutil
import subprocess

import numpy as np
import pytest
from PIL import Image

import jeuler
from jeuler.plotting import plot_correlation, plot_history, plot_net, plot_residual
from jeuler.plotting.report import FitReport, Net, Parameter, Shown
from jeuler.plotting.residuals import autocorrelation

TIMES = np.linspace(0.0, 5.0, 60)
DATA = np.stack([np.sin(3 * TIMES), np.where(TIMES < 1, np.nan, np.cos(3 * TIMES)), 0 * TIMES + np.nan], axis=1)
PARTS = {
    "title": "a <b> & c",
    "verdict": "Converged.",
    "shown": [Shown(TIMES, DATA, DATA + 1e-3 * np.sin(40 * TIMES)[:, None], ["x $1$", "y", "never seen"])],
    "parameters": [
        Parameter("ks", 20.0, 0.5, "N/m"),
        Parameter("mass", 1.0, np.inf, "kg"),
        Parameter("kd", 0.0, None, "N s/m", "at its bound 0"),
    ],
}


class Links(html.parser.HTMLParser):
    """What a page would fetch, the ids that it defines, and those that it uses."""

    def __init__(self, text):
        super().__init__()
        self.fetched, self.ids, self.used, self.tags = [], [], set(re.findall(r"url\(#([^)]+)\)", text)), []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        for name, value in attributes:
            if name in ("src", "href", "xlink:href", "srcset", "data"):
                if value.startswith("#"):
                    self.used.add(value[1:])
                elif not value.startswith("data:"):
                    self.fetched.append(value)
            if name == "id":
                self.ids.append(value)


def test_the_page_holds_all_and_fetches_nothing():
    net = Net([[0.0], [1.0], [2.0]], [[0, 1], [1, 2]], {"ks [N/m]": [1.0, np.nan]}, [True, False, False])
    page = FitReport(
        **PARTS,
        facts=[("rate", "25 Hz")],
        warnings=["A warning."],
        next_steps=["Do this."],
        correlation=(["ks", "kd"], [[1, 0.5], [0.5, 1]]),
        history=[3.0, 2.0, 1.0],
        net=net,
    ).html()
    links = Links(page)
    assert links.fetched == []
    assert not {"script", "link", "iframe"} & set(links.tags)
    assert "@import" not in page
    assert len(set(links.ids)) == len(links.ids), "ids of several figures would be mixed up"
    assert links.used <= set(links.ids)
    assert links.tags.count("figure") == 5
    for words in (
        "a &lt;b&gt; &amp; c",
        "A warning.",
        "Do this.",
        "19.02 to 20.98",
        "not determined",
        "at its bound 0",
        "25 Hz",
    ):
        assert words in page


def test_unlike_sensors_have_figures_of_their_own():
    kinds = ("position", "m", "recording 1"), ("reading of position", "", "recordings 2, 3")
    shown = [Shown(TIMES, DATA, 1.01 * DATA, ["a", "b", "c"], unit, what, whose) for what, unit, whose in kinds]
    page = FitReport(**(PARTS | {"shown": shown})).html()
    headings = re.findall("<h2>(.*?)</h2>", page)[1:]
    assert headings == [
        f"{part}: {what}, {whose}" for what, _, whose in kinds for part in ("Data and fit", "What the fit leaves")
    ]
    assert len(set(Links(page).ids)) == len(Links(page).ids)
    assert "[]" not in page


def test_what_is_not_there_has_no_heading():
    page = FitReport(**PARTS).html()
    for heading in ("Summary", "The springs", "Correlation", "The search", "What to do next"):
        assert heading not in page
    assert FitReport(**PARTS).html() == page, "the same page each time"


def test_a_page_that_fails_leaves_what_stood_there(tmp_path):
    path = tmp_path / "fit.html"
    path.write_text("before")
    with pytest.raises(ValueError, match="correlation must be"):
        FitReport(**PARTS, correlation=(["ks", "kd"], np.eye(3))).write(path)
    assert path.read_text() == "before"
    assert os.listdir(tmp_path) == ["fit.html"]
    FitReport(**PARTS).write(path)
    assert path.read_text().startswith("<!doctype html>")


@pytest.mark.skipif(shutil.which("chromium") is None, reason="needs the program chromium")
@pytest.mark.parametrize("width", [1200, 400])
def test_chromium_shows_the_report_within_the_window(tmp_path, width):
    net = Net([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]], [[0, 1], [1, 2]], {"ks [N/m]": [1.0, 2.0]})
    FitReport(**PARTS, net=net).write(tmp_path / "fit.html")
    subprocess.run(
        ["chromium", "--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking",
         f"--window-size={width},2400", f"--user-data-dir={tmp_path / 'profile'}",
         f"--screenshot={tmp_path / 'fit.png'}", (tmp_path / "fit.html").as_uri()],
        check=True, capture_output=True, timeout=60,
    )  # fmt: skip
    rgb = np.asarray(Image.open(tmp_path / "fit.png").convert("RGB")).astype(int)
    assert rgb.shape[1] == width
    ink = rgb.min(axis=2) < 200
    assert not ink[:, -8:].any(), "nothing is cut off at the right edge"
    blue = (rgb[..., 2] > 150) & (rgb[..., 0] < 60)
    assert blue.sum() > 200, "curves"
    assert (ink[:400].sum() > 2000) & (ink[400:].sum() > 2000), "words and figures"


def test_the_report_of_a_fit_of_springs(tmp_path):
    import copy

    weight = jeuler.ParticleState([[0.0], [1.2], [2.5]], np.zeros((3, 1)), mass=[np.inf, 1.0, 1.0])
    edges = [[0, 1], [1, 2]]

    def scene(ks):
        return jeuler.Scene((jeuler.Springs(edges, ks=ks, kd=0.1, rest_length=1.0),))

    times = np.linspace(0.0, 2.0, 41)
    run = jeuler.simulate(scene([30.0, 20.0]), weight, dt=0.005, num_steps=400, save_every=10, step=jeuler.rk4_step)
    noise = 1e-3 * np.random.default_rng(0).normal(size=(41, 3, 1))
    found = jeuler.fit_springs(scene([25.0, 25.0]), weight, times, run.y.position + noise, dt=0.01)
    found.report(tmp_path / "fit.html")
    page = (tmp_path / "fit.html").read_text()
    assert Links(page).fetched == []
    for k in range(2):
        error = found.stderr["ks"][k]
        assert f"{found.ks[k] - 1.96 * error:.6g} to {found.ks[k] + 1.96 * error:.6g}" in page
    assert "Test the parameters on a recording that was not fitted" in page
    assert page.count("<figure>") == 6  # series, residual, ks, kd, correlation, search
    with pytest.raises(ValueError, match="fit again"):
        copy.copy(found).report(tmp_path / "other.html")
    assert os.listdir(tmp_path) == ["fit.html"]


def test_autocorrelation_is_the_sum_over_pairs():
    x = np.array([1.0, -2.0, 0.5, 3.0])
    expected = [sum(x[i] * x[i + k] for i in range(4 - k)) / (x @ x) for k in range(4)]
    np.testing.assert_allclose(autocorrelation(x), expected, atol=1e-12)
    np.testing.assert_array_equal(autocorrelation(np.zeros(3)), [1, 0, 0])


def test_a_line_stands_at_its_frequency_and_amplitude():
    t = np.arange(200) * 0.01
    figure = plot_residual(t, 0.3 * np.sin(2 * np.pi * 5 * t)[:, None])
    frequency, amplitude = figure.axes[2].lines[0].get_data()
    assert frequency[np.argmax(amplitude)] == pytest.approx(5.0)
    assert amplitude.max() == pytest.approx(0.3, rel=1e-6)


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_nets_of_every_dimension(dim):
    position = np.random.default_rng(0).normal(size=(4, dim))
    figure = plot_net(position, [[0, 1], [1, 2], [2, 3]], [1.0, 2.0, np.nan])
    drawn = figure.axes[0].collections[0].get_segments()
    assert [segment.shape for segment in drawn] == [(2, 2)] * 3
    if dim < 3:
        np.testing.assert_allclose(drawn[0][:, :dim], position[:2])


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: plot_residual(TIMES, TIMES), "residual must be"),
        (lambda: Shown(TIMES, DATA[:, 0], DATA[:, 0], ["x"]), r"must be \(time, column\) = \(60, 1\)"),
        (lambda: plot_correlation(["ks"], np.eye(2)), "correlation must be"),
        (lambda: plot_net(np.zeros((2, 2)), [[0, 1]], [1.0, 2.0]), "edges must be"),
    ],
)
def test_shapes_that_do_not_agree(call, words):
    with pytest.raises(ValueError, match=words):
        call()


def test_a_history_with_zeros_has_a_plain_axis():
    assert plot_history([1.0, 0.1]).axes[0].get_yscale() == "log"
    assert plot_history([1.0, 0.0]).axes[0].get_yscale() == "linear"
