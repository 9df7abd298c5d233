"""Checks, pytrees and vectors: imports JAX and NumPy, nothing of ours."""

"""Checks, pytrees and vectors: imports JAX and NumPy, nothing of ours."""
