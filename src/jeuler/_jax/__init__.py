"""Everything that depends on JAX internals: the one package to check when JAX changes."""
