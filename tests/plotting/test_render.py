"""Pictures and films: what is drawn is what the state says."""

import dataclasses
import subprocess
import sys

import matplotlib

matplotlib.use("Agg")

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib import animation
from matplotlib import pyplot as plt
from matplotlib.collections import LineCollection
from PIL import Image

from jeuler import ParticleState, Scene, Solution, Springs
from jeuler.contact.colliders import Box, Plane, Sphere
from jeuler.contact.collisions import Collisions
from jeuler.plotting import Camera, Look, animate, draw
from jeuler.plotting.camera import View, new_axes
from jeuler.plotting.film import ffmpeg
from jeuler.plotting.render import save_picture
from jeuler.plotting.solids import draw_colliders, in_sight

FRAMES = 4


@pytest.fixture(autouse=True)
def closed():
    yield
    plt.close("all")


def state(dim, **fields):
    position = np.linspace(0, 1, 3 * dim).reshape(3, dim)
    return ParticleState(position, 0 * position, **fields)


def film(dim=2):
    position = np.linspace(0, 1, FRAMES * 3 * dim).reshape(FRAMES, 3, dim)
    y = ParticleState(position, 0 * position, np.ones(FRAMES), alive=np.ones((FRAMES, 3), bool))
    return Solution(jnp.arange(FRAMES) * 0.1, y, jnp.int32(-1))


def test_particles_have_their_colour_opacity_size_and_marker_and_the_dead_are_not_drawn():
    frame = state(
        2, alive=[True, True, False], color=[[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]], opacity=[0.5, 1.0, 1.0],
        size=[0.1, 0.2, 0.3], shape=[0, 1, 1],
    )  # fmt: skip
    dots = draw(frame, camera=Camera(width=2.0)).collections
    assert len(dots) == 2, "one for each marker"
    assert np.allclose(dots[0].get_facecolors(), [[1, 0, 0, 0.5]])
    assert np.allclose(dots[1].get_facecolors(), [[0, 1, 0, 1]])
    assert np.isclose(dots[1].get_sizes()[0] / dots[0].get_sizes()[0], 4), "areas go as diameters squared"
    assert np.allclose(dots[1].get_offsets(), frame.position[1:2])


@pytest.mark.parametrize("dim", [2, 3])
def test_a_metre_is_as_long_as_the_camera_says(dim):
    frame = state(dim, size=[0.5] * 3)
    ax = draw(frame, ax=new_axes(dim, "white", (6.0, 4.5)), camera=Camera(center=[0.0] * dim, width=6.0))
    diameter = np.sqrt(ax.collections[-1].get_sizes()[0])
    assert np.isclose(diameter, 0.5 * 72, rtol=0.1), "6 m on 6 inches: half a metre is 36 points"


def test_springs_are_coloured_by_strain():
    frame = ParticleState([[0.0, 0.0], [1.0, 0.0], [3.0, 0.0], [3.5, 0.0]], np.zeros((4, 2)))
    scene = Scene((Springs([[0, 1], [1, 2], [2, 3]], 1.0, 0.0, 1.0),))
    rest, stretched, pressed = draw(frame, scene).collections[0].get_colors()
    assert np.ptp(rest[:3]) < 0.05, "grey"
    assert stretched[0] > 2 * stretched[2]
    assert pressed[2] > 2 * pressed[0]


@pytest.mark.parametrize("dim", [2, 3])
def test_colliders_are_drawn(dim):
    up = [0.0] * (dim - 1) + [1.0]
    solids = (Plane([0.5] * dim, up), Sphere([0.5] * dim, 0.2), Box([0.2] * dim, 0.1), lambda t, p: jnp.max(p) - 0.3)
    for solid in solids:
        with_solid = draw(state(dim), Scene(effects=(Collisions((solid,)),)))
        assert len(with_solid.collections) > len(draw(state(dim)).collections)


def test_what_a_solid_hides_is_not_drawn():
    ball = [Sphere([0.0, 0.0, 0.0], 1.0)]
    points = np.array([[3.0, 0.0, 0.0], [-3.0, 0.0, 0.0], [-3.0, 2.0, 0.0], [1.001, 0.0, 0.0]])
    assert in_sight(ball, 0.0, points, np.array([1.0, 0.0, 0.0]), 8.0).tolist() == [True, False, True, True]


def test_a_film_is_written_as_gif_and_html_and_shown_in_a_notebook(tmp_path, capsys):
    animate(film(), path=tmp_path / "film.gif", progress=False, title="t = {t} s")
    with Image.open(tmp_path / "film.gif") as image:
        assert image.n_frames == FRAMES
        assert image.size == (480, 360)
    assert capsys.readouterr().err == "", "no bar where none is wanted"
    player = animate(film(3), every=2)
    assert player.frames == 2
    html = player._repr_html_()
    bar = capsys.readouterr().err
    assert "drawing" in bar
    assert "2/2" in bar
    assert html.count("data:image/png;base64") == 2
    dataclasses.replace(player, progress=False).save(tmp_path / "film.html")
    assert (tmp_path / "film.html").stat().st_size == len(html.encode())


def test_mp4_needs_ffmpeg_and_says_so(tmp_path, monkeypatch):
    monkeypatch.setattr(animation.FFMpegWriter, "isAvailable", classmethod(lambda cls: False))
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(RuntimeError, match=r"film.mp4 needs the program ffmpeg.*write film.gif or film.html"):
        animate(film(), path=tmp_path / "film.mp4", progress=False)


def test_the_frames_of_an_mp4_are_those_of_the_film(tmp_path):
    animate(film(), path=tmp_path / "film.mp4", camera=Camera(width=3.0), progress=False)
    subprocess.run([ffmpeg(), "-v", "error", "-i", tmp_path / "film.mp4", tmp_path / "frame%d.png"], check=True)
    assert len(list(tmp_path.glob("frame*.png"))) == FRAMES
    save_picture(
        tmp_path / "expected.png", jax.tree.map(lambda x: x[2], film().y), camera=Camera([0.5, 0.5], width=3.0)
    )
    found, expected = (
        np.asarray(Image.open(tmp_path / f"{n}.png").convert("L"), float) for n in ("frame3", "expected")
    )
    assert expected.min() < 150, "there are particles"
    assert np.abs(found - expected).mean() < 1, "but for the losses of the codec"


def test_a_player_holds_every_frame_of_a_large_film(monkeypatch):
    """Matplotlib drops the frames beyond its limit of megabytes with no more than a line in the log."""
    monkeypatch.setitem(plt.rcParams, "animation.embed_limit", 1e-3)
    assert animate(film(), progress=False)._repr_html_().count("data:image/png;base64") == FRAMES


def test_a_title_is_read_on_any_background():
    for background, color in (("white", "black"), ("#10151f", "white")):
        figure, pictures = animate(film(), look=Look(background), title="t = {t} s", progress=False)._draw_all()
        list(pictures)
        assert (figure._suptitle.get_text(), figure._suptitle.get_color()) == ("t = 0.30 s", color)


def test_springs_take_the_colour_of_their_particles_or_are_not_drawn():
    scene = Scene((Springs([[0, 1], [1, 2]], 1.0, 0.0, 1.0),))
    frame = state(3, color=[[1.0, 0, 0], [0, 0, 1.0], [0, 0, 1.0]])
    lines = draw(frame, scene, look=Look(links="color", particles=False)).collections
    assert len(lines) == 1, "and no particles"
    assert sorted(lines[0].get_colors().tolist()) == [[0, 0, 1, 1], [0.5, 0, 0.5, 1]]
    assert len(draw(frame, scene, look=Look(links=None)).collections) == 1
    with pytest.raises(ValueError, match=r'Look.links must be "strain", "color" or None, got \'none\''):
        Look(links="none")


def test_faces_are_lit_and_those_behind_a_solid_are_left_out():
    corners = np.array([[0.0, -1, -1], [0, 1, -1], [0, 0, 1]])
    position = np.concatenate([corners + np.array([3.0, 0, 0]), 0.5 * corners - [3.0, 0, 0], corners - [6.0, 0, 5.0]])
    frame = ParticleState(position, 0 * position, color=np.tile([1.0, 0.5, 0.0], (9, 1)))
    scene = Scene(effects=(Collisions((Sphere([0.0, 0.0, 0.0], 2.0),)),))
    look = Look(faces=[[0, 1, 2], [3, 4, 5], [6, 7, 8]], particles=False)
    ax = draw(frame, scene, look=look, camera=Camera([0.0] * 3, 20.0, azimuth=0.0, elevation=0.0))
    faces = next(c for c in ax.collections if c.get_zorder() == 1.5)
    assert len(faces.get_facecolor()) == 2
    assert np.allclose(faces.get_facecolor()[:, 0] / faces.get_facecolor()[:, 1], 2), "a shade of their own colour"
    with pytest.raises(ValueError, match=r"Look.faces must have shape \(face, 3\)"):
        Look(faces=[0, 1, 2])


def test_the_ground_is_drawn_first_and_what_is_near_last():
    solids = (Sphere([5.0, 0.0, 0.5], 0.5), Box([-5.0, 0.0, 0.5], 0.5), Plane([0.0] * 3, [0.0, 0.0, 1.0]))
    for azimuth, nearest in ((0.0, 1), (180.0, 0)):
        view = View.of(Camera([0.0] * 3, 20.0, azimuth=azimuth), np.zeros((1, 1, 3)), np.ones((1, 1), bool))
        ax = new_axes(3, "white")
        artists = draw_colliders(ax, list(solids), 0.0, view)
        ground, *others = artists
        assert ground.get_zorder() < others[0].get_zorder() < others[1].get_zorder()
        faces = [len(artist.get_facecolor()) for artist in others]
        assert min(faces) == 3, "the box shows three sides"
        assert np.argmax(faces) == nearest, "the ball is in front from +x, the box from -x"


def test_the_camera_follows():
    frame = state(2)
    followed = draw(frame, camera=Camera(width=1.0, follow=2))
    assert np.allclose(np.mean(followed.get_xlim()), frame.position[2, 0])
    mean = draw(frame, camera=Camera(width=1.0, follow="mean"))
    assert np.allclose(np.mean(mean.get_ylim()), frame.position[:, 1].mean())


def test_the_ground_fills_the_picture_to_its_edges(tmp_path):
    """Whatever the shape of the cloud, and of the picture."""
    frame = ParticleState([[0.0, 0.0], [0.1, 3.0]], np.zeros((2, 2)))
    ground = Scene(effects=(Collisions((Plane([0.0, 1.0], [0.0, 1.0]),)),))
    for size in ((6.0, 4.5), (3.0, 6.0)):
        save_picture(tmp_path / "ground.png", frame, ground, size=size)
        pixels = np.asarray(Image.open(tmp_path / "ground.png").convert("RGB"))
        assert np.all(pixels[-3:] == pixels[-1, 0]), "the lowest rows are ground"
        assert tuple(pixels[-1, 0]) != (255, 255, 255)
        assert tuple(pixels[0, 0]) == (255, 255, 255)


def test_a_whole_solution_is_no_frame_and_a_path_has_a_known_end(tmp_path):
    with pytest.raises(ValueError, match=r"frame.position must have shape \(particle, dim\), dim 1, .* take one frame"):
        draw(film().y)
    with pytest.raises(ValueError, match=r"must end in .gif, .mp4 or .html, got 'film.avi'"):
        animate(film(), path=tmp_path / "film.avi")
    with pytest.raises(ValueError, match=r"needs a solution whose .y is a ParticleState"):
        animate(Solution(jnp.zeros(2), jnp.zeros(2), jnp.int32(-1)))


def test_what_moves_on_a_line_is_drawn_and_filmed(tmp_path):
    springs = Springs([[0, 1]], ks=25.0, kd=0.3, rest_length=1.0)
    scene = Scene((springs,), (Collisions((Plane([-0.3], [1.0]),)),))
    weight = ParticleState([[0.0], [1.5]], np.zeros((2, 1)), mass=[jnp.inf, 1.0])
    solution = Solution(jnp.arange(2.0), jax.tree.map(lambda x: jnp.stack([x, x]), weight), jnp.int32(-1))
    made = animate(solution, scene, tmp_path / "line.gif", progress=False)
    assert repr(made) == "Film(2 frames, to t = 1 s, 25 a second of film)"
    with Image.open(tmp_path / "line.gif") as picture:
        assert picture.n_frames == 1, "nothing moves: Pillow keeps one"
    ax = draw(weight, scene, camera=Camera(center=[0.5], width=3.0))
    lines = next(c for c in ax.collections if isinstance(c, LineCollection))
    np.testing.assert_allclose(lines.get_segments(), [[[0.0, 0.0], [1.5, 0.0]]])
    assert np.allclose(ax.get_xlim(), [-1.0, 2.0])
