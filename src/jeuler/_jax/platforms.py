"""What is chosen by platform, in one table. CPU's column is measured; the others are JAX's own defaults, unmeasured."""

from __future__ import annotations

import jax

CPU = "cpu"

# Many small systems under ``vmap`` with the batch axis last in memory (`members`): loops of 1,024 instead of 16.
BATCH_LAST = {CPU: True, "gpu": False, "tpu": False}


def batch_last() -> bool:
    """Whether many small systems run with the batch axis last on the default device."""
    return BATCH_LAST.get(jax.default_backend(), False)
