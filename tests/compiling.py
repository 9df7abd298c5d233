"""The programs that JAX compiles while a test looks."""

from contextlib import contextmanager

import jax

LOOKING = []  # lists of seconds; JAX 0.8 has no way to take a listener back


def _listen(name, duration, **_):
    if name == "/jax/core/compile/backend_compile_duration":
        for seconds in LOOKING:
            seconds.append(duration)


jax.monitoring.register_event_duration_secs_listener(_listen)


@contextmanager
def compiled_programs():
    """A list that grows by the seconds of each program that is compiled."""
    seconds = []
    LOOKING.append(seconds)
    try:
        yield seconds
    finally:
        LOOKING.pop()
