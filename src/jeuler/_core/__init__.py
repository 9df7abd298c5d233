"""Checks, pytrees and vectors: imports JAX and NumPy, and no other package of jeuler."""
