"""Programs that run for less time than XLA's optimiser takes over them: compiled with less of it."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, Literal

import jax

Haste = Literal["none", "some", "great"]

# XLA:CPU writes fused loops by its emitters of MLIR, which takes more than half of the compile time of a small program;
# without them the older emitter of LLVM does, and the loops run up to 1.3 times as long. Without LLVM's optimiser they
# run 2 to 5 times as long; one piece of code is then quicker than several on threads.
OPTIONS: dict[str, dict[str, Any]] = {
    "none": {},
    "some": {"xla_cpu_use_fusion_emitters": False},
    "great": {
        "xla_backend_optimization_level": 0,
        "xla_cpu_use_fusion_emitters": False,
        "xla_cpu_parallel_codegen_split_count": 1,
    },
}


def jit_in_haste(function: Callable[..., Any], haste: Haste, **settings: Any) -> Callable[..., Any]:
    """``jax.jit``, on a CPU with less work for the compiler; plain where this version of XLA has no such options."""
    plain = jax.jit(function, **settings)
    if haste == "none" or jax.default_backend() != "cpu":
        return plain
    chosen = [jax.jit(function, compiler_options=OPTIONS[haste], **settings)]

    @functools.wraps(function)
    def call(*arguments: Any) -> Any:
        try:
            return chosen[0](*arguments)
        except jax.errors.JaxRuntimeError as error:
            if chosen[0] is plain or "No such compile option" not in str(error):
                raise
            chosen[0] = plain
            return plain(*arguments)

    return call
