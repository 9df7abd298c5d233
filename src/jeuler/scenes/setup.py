"""What an example scene gives: the scene, its initial state, how to run it and how to look at it."""

from __future__ import annotations

import dataclasses
import importlib.util
from typing import Any

import jax

from jeuler._core.component import result
from jeuler.particles import ParticleState, Scene, simulate
from jeuler.solving._scan import Solution
from jeuler.steps.explicit import symplectic_euler_step


@result
class Setup:
    """A scene that is ready to run and to be looked at.

    Args:
      scene, state: what `simulate` takes.
      dt, num_steps, save_every: how it takes them, dt in s.
      camera, look: named arguments of a ``plotting.Camera`` and a ``plotting.Look``.
      frame: the saved state that makes the best picture.
      step: the method.
    """

    scene: Scene
    state: ParticleState
    dt: float
    num_steps: int
    save_every: int
    camera: dict[str, Any] = dataclasses.field(default_factory=dict)
    look: dict[str, Any] = dataclasses.field(default_factory=dict)
    frame: int = -1
    step: Any = symplectic_euler_step

    def run(self, seed: int = 0, **changes: Any) -> Solution:
        """The solution; ``changes`` are arguments of `simulate` to take instead."""
        arguments: dict[str, Any] = {
            "dt": self.dt,
            "num_steps": self.num_steps,
            "save_every": self.save_every,
            "step": self.step,
        }
        key = jax.random.key(seed)
        return jax.jit(lambda scene, state: simulate(scene, state, key=key, **(arguments | changes)))(
            self.scene, self.state
        )

    def film(self, path: Any = None, **options: Any) -> Any:
        """The film of the run, written to the path (.gif, .mp4, .html) if there is one."""
        from jeuler.plotting.film import animate

        return animate(self.run(), self.scene, path, **(self._shown() | options))

    def picture(
        self, path: Any, frame: int | None = None, solution: Solution | None = None,
        size: tuple[int, int] = (1600, 1000),
    ) -> None:  # fmt: skip
        """A picture of one saved state, size in pixels: in space by ``plotting.still`` where PyVista is installed."""
        from jeuler.plotting.render import save_picture
        from jeuler.plotting.studio import still

        solution = self.run() if solution is None else solution
        frame = self.frame if frame is None else frame
        state, t = jax.tree.map(lambda x: x[frame], solution.y), float(solution.t[frame])
        if state.position.shape[-1] == 3 and importlib.util.find_spec("pyvista"):
            still(state, self.scene, path, t=t, size=size, **self._shown())
        else:
            save_picture(path, state, self.scene, t=t, size=(size[0] / 100, size[1] / 100), dpi=100, **self._shown())

    def view(self, path: Any = None, **options: Any) -> Any:
        """The run as a ``plotting.view`` that is turned with the mouse, written to the path (.html) if there is one."""
        from jeuler.plotting.turnable import view

        return view(self.run(), self.scene, path, **(self._shown() | options))

    def _shown(self) -> dict[str, Any]:
        from jeuler.plotting.camera import Camera
        from jeuler.plotting.render import Look

        return {"camera": Camera(**self.camera), "look": Look(**self.look)}
