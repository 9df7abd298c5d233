"""Where the command line keeps its compiled programs, how many, and when it does not."""

import os

import jax
import pytest

from jeuler.commands import program_cache

NAMES = "jax_compilation_cache_dir", "jax_enable_compilation_cache", "jax_persistent_cache_min_compile_time_secs"


@pytest.fixture
def config(monkeypatch, tmp_path):
    """JAX without a folder of its own, a home that is empty, and all as it was afterwards."""
    before = {name: getattr(jax.config, name) for name in NAMES}
    for name in ("XDG_CACHE_HOME", "LOCALAPPDATA", "HOME"):
        monkeypatch.setenv(name, str(tmp_path))
    jax.config.update("jax_compilation_cache_dir", None)
    yield tmp_path
    for name, value in before.items():
        jax.config.update(name, value)


def test_programs_go_to_the_users_cache_folder(config):
    place = program_cache.keep_programs()
    assert place.is_dir()
    assert place.parent == config / "jeuler"
    assert jax.config.jax_compilation_cache_dir == str(place)
    assert jax.config.jax_persistent_cache_min_compile_time_secs == 0


def test_a_folder_that_jax_has_already_is_left_alone(config):
    jax.config.update("jax_compilation_cache_dir", str(config / "mine"))
    assert program_cache.keep_programs() is None
    assert jax.config.jax_compilation_cache_dir == str(config / "mine")


def test_jax_can_switch_it_off(config):
    jax.config.update("jax_enable_compilation_cache", False)
    assert program_cache.keep_programs() is None
    assert jax.config.jax_compilation_cache_dir is None
    assert not list(config.iterdir())


def test_where_nothing_can_be_written_nothing_is_kept(config, monkeypatch):
    (config / "file").write_text("")
    for name in ("XDG_CACHE_HOME", "LOCALAPPDATA", "HOME"):
        monkeypatch.setenv(name, str(config / "file"))
    assert program_cache.keep_programs() is None
    assert jax.config.jax_compilation_cache_dir is None


def test_what_was_not_used_for_the_longest_goes_first(tmp_path):
    for age, size in enumerate((300, 300, 300, 300)):
        file = tmp_path / "machine" / f"{age}"
        file.parent.mkdir(exist_ok=True)
        file.write_bytes(bytes(size))
        os.utime(file, (1e9 - age, 1e9 - age))
    program_cache.shorten(tmp_path, 700)
    assert sorted(file.name for file in tmp_path.rglob("*") if file.is_file()) == ["0", "1"]
    program_cache.shorten(tmp_path / "none", 0)
