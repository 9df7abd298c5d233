"""``ensemble``: one run for many members, in batches that fit memory, on one device or on all of a mesh."""

from __future__ import annotations

import contextlib
import functools
import operator
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import NamedSharding, PartitionSpec

from jeuler._core import checks
from jeuler._core.arguments import says_what_to_write
from jeuler._core.component import Function, result
from jeuler._jax import programs
from jeuler.solving._scan import Solution
from jeuler.solving.chunks import Progress, _telling, check_progress
from jeuler.solving.kept_members import MEMBERS, KeptMembers, in_touch
from jeuler.solving.long_runs import check_resume, fingerprint
from jeuler.solving.store import Store

PyTree = Any
MEMORY = 2**26  # bytes of the results of a batch, where the user does not say how large,
MOST = 2**14  # members at most


@result
class Ensemble:
    """What became of the members.

    Attributes:
      results: what the run gave, each leaf with a leading axis (member, ...); None where it was reduced. With
        ``resume`` a leaf is read from disk where it is indexed or converted.
      reduced: what ``reduce`` made of the results of the members that were not lost; None without it.
      lost: the numbers of the members that were lost, (lost,), rising: their results hold a number that is not finite.
      count: how many members there were.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> found = jeuler.ensemble(lambda x: 1 / x, jnp.array([1.0, 0.0, 2.0]))
      >>> found.count, found.lost.tolist(), found.results.tolist()
      (3, [1], [1.0, inf, 0.5])
    """

    results: PyTree
    reduced: Any
    lost: np.ndarray
    count: int


@says_what_to_write(batch_size="batch=...", reducers="reduce=...", keys="members")
def ensemble(
    run: Callable[[PyTree], PyTree],
    members: PyTree,
    *,
    batch: int | None = None,
    mesh: Any = None,
    reduce: Any = None,
    progress: Progress = None,
    resume: Any = None,
    checkpoint_every: int | None = None,
) -> Ensemble:
    """Run each member, batch after batch, and keep the results or what a reducer makes of them.

        results[i] = run(members[i])

    Args:
      run: a function of one member, which calls `solve` or `simulate` and returns a pytree of arrays, such as the last
        state. Written for one, it may depend on the member in all but shapes: start, parameters, key, dt.
      members: a pytree of arrays with a leading axis (member, ...).
      batch: members at once; None for as many as give 64 MiB of results, at most 16,384. On a mesh, a multiple of its
        devices.
      mesh: a ``jax.sharding.Mesh``: each batch is divided over all its devices, which send nothing to each other. With
        ``jax.distributed`` all processes make the same call with the same members.
      reduce: a reducer such as `Moments` or `Quantiles`, or a dictionary of them, so that the results need not be
        stored. An object of your own with their four methods does too.
      progress: True shows a bar; a function is called as ``progress(member, members)`` after each batch.
      resume: path of a folder that keeps what the reducers have behind them, or the results, and from which the same
        call goes on after a kill, with the numbers of a run in one go, to the bit. Of several processes the first one
        writes; all are started again. Results that are not reduced need zarr, ``pip install 'jeuler[runs]'``.
      checkpoint_every: members between two states on disk, at the end of a batch; None for one about each 10 s.
    Returns: `Ensemble`.
    Raises: ValueError, before tracing, if the members have no common leading axis, a batch does not fit the mesh, or
      the folder holds something else; RuntimeError, if another process has ended.
    Example:
      >>> import jax, jax.numpy as jnp, jeuler
      >>> def end(ks):
      ...     run = jeuler.solve(lambda t, y, ks: (y[1], -ks * y[0]), (1.0, 0.0), args=ks, dt=0.01, num_steps=100)
      ...     return run.y[0][-1]
      >>> stiffness = 1 + 0.1 * jax.random.normal(jax.random.key(0), (1000,))
      >>> found = jeuler.ensemble(end, stiffness, reduce=jeuler.Moments())
      >>> round(float(found.reduced.mean), 2), found.lost.size
      (0.54, 0)
    """
    checks.function("run", run, "(member) -> results", "write run=lambda member: jeuler.solve(...).y, say")
    count = _number_of(members)
    check_progress(progress, None)
    check_resume(resume, checkpoint_every, None, frames=reduce is None)
    if programs.is_transformed():
        raise ValueError(
            "ensemble works outside of jit, vmap and grad, got a call inside; write jax.vmap(run)(members)"
        )
    reducers = reduce if isinstance(reduce, dict) else {} if reduce is None else {"": reduce}
    for name, one in reducers.items():
        if not all(hasattr(one, method) for method in ("start", "add", "merge", "value")):
            raise ValueError(f"reduce must have start, add, merge and value, got {checks.shown(one)} {name}".rstrip())
    size = _size_of_batch(run, members, count, batch, mesh)
    work = _Work(run, tuple(reducers.items()), mesh, size, count)
    if resume is not None:
        work.keep_in(resume, members, checkpoint_every)
    with _telling(progress, count) as tell, work.kept_at_the_end():
        for first in range(work.done, count, size):
            work.batch(jax.tree.map(operator.itemgetter(slice(first, first + size)), members))
            if tell:
                tell(work.done)
    results, states, lost = work.end()
    values = {name: one.value(states[name]) for name, one in reducers.items()}
    reduced = None if reduce is None else values if isinstance(reduce, dict) else values[""]
    return Ensemble(results, reduced, np.flatnonzero(lost), count)


def _number_of(members: PyTree) -> int:
    sizes = {np.shape(x)[:1] for x in jax.tree.leaves(members)}
    if len(sizes) != 1 or sizes == {()} or sizes == {(0,)}:
        shapes = [np.shape(x) for x in jax.tree.leaves(members)]
        raise ValueError(f"members must be arrays with one leading axis (member, ...), got the shapes {shapes}")
    return next(iter(sizes))[0]


def _size_of_batch(run: Callable, members: PyTree, count: int, batch: int | None, mesh: Any) -> int:
    devices = 1 if mesh is None else mesh.size
    if batch is not None:
        checks.count("batch", batch, least=1)
        if batch % devices:
            raise ValueError(f"batch must be a multiple of the {devices} devices of the mesh, got {batch}")
        return batch
    one = jax.tree.map(lambda x: jax.ShapeDtypeStruct(np.shape(x)[1:], x.dtype), members)
    form = checks.form_of("run", run, one)
    each = sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(form))
    size = int(np.clip(MEMORY // max(each, 1), 1, MOST))
    return min(size, -(-count // devices)) * devices


class _Work:
    """The batches of one call."""

    def __init__(self, run: Callable, reducers: tuple, mesh: Any, size: int, count: int) -> None:
        self.run, self.mesh, self.size, self.reducers, self.count = run, mesh, size, reducers, count
        self.axes: Any = None if mesh is None else PartitionSpec(mesh.axis_names)
        self.begin = programs.prepared(_first_states, (Function(run),), (reducers,))
        self.step = programs.prepared(_next, (Function(run),), (reducers, mesh))
        self.done: int = 0
        self.states: PyTree = None
        self.results: list[PyTree] = []
        self.lost: list[Any] = []
        self.kept: KeptMembers | None = None

    def keep_in(self, resume: Any, members: PyTree, every: int | None) -> None:
        """Keep the work in this folder, and go on from what is there."""
        batch = jax.tree.map(lambda x: jax.ShapeDtypeStruct((self.size, *np.shape(x)[1:]), x.dtype), members)
        real = jax.ShapeDtypeStruct((self.size,), np.bool_)
        states = jax.eval_shape(functools.partial(_first_states, Function(self.run), self.reducers, {}), batch, real)
        # on one device, so that it does not matter which of several processes has which
        lowered, dynamic = programs.lowered(_next, (Function(self.run),), (self.reducers, None), states, batch, real)
        _check_same_form(states, lowered.out_info[0])
        devices = 1 if self.mesh is None else self.mesh.size
        store = Store(resume, fingerprint(lowered, [*dynamic, *jax.tree.leaves(members), devices]), MEMBERS)
        if self.mesh is not None:
            states = jax.tree.map(lambda x: jax.ShapeDtypeStruct((devices, *x.shape), x.dtype), states)
        like = states, jax.ShapeDtypeStruct((self.count,), np.bool_)
        one = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), batch)
        result = None if self.reducers else jax.eval_shape(self.run, one)
        self.kept = KeptMembers(store, like, result, self.count, self.size, every)
        if self.kept.state is not None:
            self.states, lost = self.kept.state
            self.states = jax.tree.map(jnp.asarray if self.mesh is None else self._placed, self.states)
            self.done = self.kept.done
            self.lost = [lost[: self.done]]

    def batch(self, members: PyTree) -> None:
        count = min(self.size, self.count - self.done)
        members = jax.tree.map(self._padded, members)
        real = np.arange(self.size) < count
        if self.states is None:
            states = self.begin({}, members, real)
            self.states = states if self.mesh is None else jax.tree.map(self._on_each_device, states)
        self.states, results, lost = self.step(self.states, *jax.tree.map(self._placed, (members, real)))
        self.lost.append(lost)
        if not self.reducers:
            # on the host, so that the memory of the device holds one batch
            if self.kept:
                self.kept.write(self.done, self._whole(results), count)
            else:
                self.results.append(jax.tree.map(np.asarray, results) if jax.process_count() == 1 else results)
        self.done += count
        if self.kept and (self.done >= self.kept.due or self.done == self.count):
            self._keep(self.kept)

    def _keep(self, kept: KeptMembers) -> None:
        lost = np.zeros(self.count, bool)
        lost[: self.done] = self._lost()
        self.lost = [lost[: self.done]]
        kept.keep((self._whole(self.states), lost), self.done)

    @contextlib.contextmanager
    def kept_at_the_end(self) -> Iterator[None]:
        """What is done is kept also where Ctrl-C or the bar ends it, unless that was amid a batch."""
        try:
            yield
        except (Exception, KeyboardInterrupt) as error:
            usable = not any(getattr(x, "is_deleted", bool)() for x in jax.tree.leaves(self.states))
            alone = jax.process_count() == 1 and not isinstance(error, OSError)
            if self.kept and alone and usable and self.done > self.kept.done:
                self._keep(self.kept)
            raise

    def _padded(self, x: Any) -> Any:
        missing = self.size - len(x)
        if not missing:
            return x
        if jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
            return jnp.concatenate([x, jnp.repeat(x[-1:], missing, axis=0)])
        return np.concatenate([np.asarray(x), np.repeat(np.asarray(x[-1:]), missing, axis=0)])

    def _placed(self, x: Any) -> Any:
        if self.mesh is None:
            return x
        sharding = NamedSharding(self.mesh, self.axes)
        if jax.process_count() == 1 or jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
            return jax.device_put(x, sharding)
        return jax.make_array_from_callback(np.shape(x), sharding, lambda index: x[index])

    def _on_each_device(self, x: Any) -> Any:
        return self._placed(np.broadcast_to(np.asarray(x), (self.mesh.size, *x.shape)))

    def end(self) -> tuple[PyTree, dict[str, PyTree], np.ndarray]:
        """All results, the states of the reducers, and which members were lost."""
        lost = self._lost()
        results = None
        if self.kept:
            results = self.kept.results()
        elif not self.reducers:
            pieces = [self._whole(piece) for piece in self.results]
            results = jax.tree.map(lambda *parts: np.concatenate(parts)[: self.count], *pieces)
        states = self.states
        if self.mesh is not None:
            states = self._whole(states)
            parts = [jax.tree.map(lambda x, n=n: jnp.asarray(x[n]), states) for n in range(self.mesh.size)]
            states = parts[0]
            for part in parts[1:]:
                states = {name: one.merge(states[name], part[name]) for name, one in self.reducers}
        return results, states, lost

    def _lost(self) -> np.ndarray:
        return np.concatenate([self._whole(x) for x in self.lost])[: self.done]

    def _whole(self, tree: PyTree) -> PyTree:
        """The arrays with what all processes have of them."""
        if self.mesh is None or jax.process_count() == 1:
            return jax.tree.map(np.asarray, tree)
        from jax.experimental import multihost_utils

        def whole(x):
            return x if isinstance(x, np.ndarray) else np.asarray(multihost_utils.process_allgather(x, tiled=True))

        with self.kept.in_touch() if self.kept else in_touch("begin anew, and give resume= to keep what is done"):
            return jax.tree.map(whole, tree)


def _batch(run: Function, members: PyTree, real: Any) -> tuple[PyTree, Any]:
    results = jax.vmap(run.function)(members)
    return results, ~_finite(results) & real


def _finite(results: PyTree) -> Any:
    """Which members have only finite results, and no run among them that was lost on its way."""
    runs = jax.tree.leaves(results, is_leaf=lambda x: isinstance(x, Solution))
    found = [one.first_nonfinite < 0 for one in runs if isinstance(one, Solution)]
    for x in jax.tree.leaves(results):
        if jnp.issubdtype(x.dtype, jnp.inexact):
            found.append(jnp.all(jnp.isfinite(x), axis=tuple(range(1, x.ndim))))
    whole = jnp.ones(len(jax.tree.leaves(results)[0]), bool)
    for one in found:
        whole = whole & one
    return whole


def _check_same_form(states: dict[str, PyTree], later: dict[str, PyTree]) -> None:
    """A state that changes its form from batch to batch cannot be known again on disk."""
    for name, before in states.items():
        forms = [str(jax.tree.map(lambda x: f"{x.dtype}{list(x.shape)}", tree)) for tree in (before, later[name])]
        if forms[0] != forms[1]:
            raise ValueError(
                f"with resume= what start and add of a reducer return must have the same shapes and dtypes, "
                f"got {forms[0]} and {forms[1]} {name}".rstrip()
            )


def _first_states(run: Function, reducers: tuple, _: PyTree, members: PyTree, real: Any) -> PyTree:
    results, lost = _batch(run, members, real)
    return {name: one.start(results, real & ~lost) for name, one in reducers}


def _next(run: Function, reducers: tuple, mesh: Any, states: PyTree, members: PyTree, real: Any) -> tuple:
    """States, results (none where they are reduced), and which members were lost, after a batch."""

    def one_device(states, members, real):
        results, lost = _batch(run, members, real)
        if not reducers:
            return states, results, lost
        return {name: one.add(states[name], results, real & ~lost) for name, one in reducers}, None, lost

    if mesh is None:
        return one_device(states, members, real)

    def of_device(states, members, real):
        states, *rest = one_device(jax.tree.map(lambda x: x[0], states), members, real)
        return jax.tree.map(lambda x: x[None], states), *rest

    spec = PartitionSpec(mesh.axis_names)
    return jax.shard_map(of_device, mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False)(states, members, real)
