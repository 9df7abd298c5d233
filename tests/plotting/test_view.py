"""The view that is turned with the mouse: one page without a network, that shows what the state says."""

import http.server
import re
import shutil
import subprocess
import threading
import time

import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from jeuler import ParticleState, Scene, Solution, Springs
from jeuler.contact import Box, Collisions, Plane, Sphere
from jeuler.plotting import Camera, Look, view
from jeuler.plotting.camera import View
from jeuler.plotting.surfaces import mesh_of
from jeuler.plotting.turnable import first_look, in_space, packed

RED = [1.0, 0.0, 0.0]


def run(dim=3, frames=3, **fields):
    position = np.linspace(-1, 1, frames * 4 * dim).reshape(frames, 4, dim)
    y = ParticleState(position, 0 * position, np.ones(frames), **fields)
    return Solution(jnp.arange(frames) * 0.1, y, jnp.int32(-1))


SCENE = Scene(
    (Springs([[0, 1], [2, 3]], 1.0, 0.0, 0.5),),
    (Collisions((Sphere([0.0, 0.0, 0.0], 0.5), Box([1.0, 0.0, 0.0], [0.2, 0.2, 0.2]), Plane([0.0, 0.0, -1.0], [0, 0, 1]))),),
)  # fmt: skip


def test_the_page_is_one_file_that_loads_nothing(tmp_path):
    view(run(), SCENE, tmp_path / "run.html", look=Look(faces=[[0, 1, 2]]))
    page = (tmp_path / "run.html").read_text()
    assert [path.name for path in tmp_path.iterdir()] == ["run.html"]
    assert len(page) < 3e6
    markup = re.sub(r"<script[^>]*>.*?</script>", "", page, flags=re.DOTALL)
    assert not re.search(r"\b(src|href|action|data)\s*=|url\(|@import", markup)
    assert not re.search(r"<script[^>]*\bsrc", page)
    addresses = set(re.findall(r"https?://[^\"'\s<>]+", page))
    assert addresses <= {"https://requirejs.org/docs/errors.html#", "http://www.w3.org/1999/xhtml"}, "names, not loaded"


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_a_run_of_any_dimension_has_a_view_that_a_notebook_shows(dim):
    alive = np.array([[True, True, False, True]] * 3)
    shown = view(run(dim, alive=alive, size=np.full((3, 4), 0.1)), Scene((Springs([[0, 1]], 1.0, 0.0, 1.0),)))
    assert repr(shown) == "TurnableView(3 frames, 4 particles, to t = 0.2 s)"
    assert shown._repr_html_().startswith("<iframe srcdoc=")


def test_long_runs_are_thinned_to_a_hundred_frames_and_every_is_taken_as_it_is():
    assert "(84 frames" in repr(view(run(frames=250)))
    assert "(250 frames" in repr(view(run(frames=250), every=1))


def test_bad_input_says_what_to_do(tmp_path):
    with pytest.raises(ValueError, match=r"end in .html, got 'run.gif'"):
        view(run(), path=tmp_path / "run.gif")
    with pytest.raises(ValueError, match="save=None"):
        view(Solution(jnp.arange(3), jnp.zeros((3, 2)), jnp.int32(-1)))
    with pytest.raises(ValueError, match="every must be"):
        view(run(), every=0)


def test_colours_are_packed_and_the_eye_looks_at_the_middle():
    assert packed(np.array([[1.0, 0, 0, 0.5], [0, 1.0, 2.0, 1]])).tolist() == [0xFF0000, 0x00FFFF]
    assert in_space(np.ones((2, 1))).tolist() == [[1, 0, 0]] * 2
    position = np.array([[[-1.0, -1.0, 0.0], [1.0, 1.0, 0.0]]])
    extent = View.of(Camera(azimuth=0.0, elevation=0.0), position, np.ones((1, 2), bool))
    eye = np.array(first_look(extent, 0.0, flat=False))
    assert eye[0] > 3
    assert np.allclose(eye[1:], [0, 0, 0, 0, 0, 0, 0, 1])


@pytest.mark.parametrize(
    "solid", [Sphere([0.1, 0.0, 0.0], 0.4), Box([0.0, 0.1, 0.0], [0.2, 0.3, 0.4]), Plane([0.0, 0.0, 0.1], [0.3, 0, 1])],
    ids=["sphere", "box", "plane"],
)  # fmt: skip
def test_the_triangles_of_a_solid_lie_where_its_distance_is_zero(solid):
    points, faces = mesh_of(solid, 0.0, np.zeros(3), np.ones(3), cells=12)
    assert len(faces) > 10
    assert faces.max() < len(points)
    assert max(abs(float(solid(0.0, jnp.asarray(p)))) for p in points[::7]) < 1e-5


class Waits(http.server.BaseHTTPRequestHandler):
    """Answers late, so that Chromium takes its picture when the page has been drawn."""

    def do_GET(self):
        time.sleep(4)
        self.send_error(404)

    def log_message(self, *words):
        pass


@pytest.mark.skipif(shutil.which("chromium") is None, reason="needs the program chromium")
def test_chromium_draws_the_particles(tmp_path):
    solution = run(frames=1, color=np.tile(RED, (1, 4, 1)), size=np.full((1, 4), 0.6))
    page = view(solution, camera=Camera(center=[0.0, 0.0, 0.0], width=3.0)).page()
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Waits) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        late = f'<img src="http://127.0.0.1:{server.server_port}/">'
        (tmp_path / "run.html").write_text(page.replace("</body>", late + "</body>"))
        subprocess.run(
            ["chromium", "--headless", "--no-sandbox", "--disable-background-networking", "--use-gl=angle",
             "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--window-size=400,300",
             f"--user-data-dir={tmp_path / 'profile'}", f"--screenshot={tmp_path / 'run.png'}",
             (tmp_path / "run.html").as_uri()], check=True, capture_output=True, timeout=60,
        )  # fmt: skip
        server.shutdown()
    rgb = np.asarray(Image.open(tmp_path / "run.png").convert("RGB")).astype(int)
    reddish = (rgb[..., 0] > 60) & (rgb[..., 1] < 90) & (rgb[..., 2] < 90) & (rgb[..., 0] > rgb[..., 1] + 50)
    assert 500 < reddish.sum() < 60000, "four red balls on white"
