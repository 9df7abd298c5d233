"""All that leans on JAX internals: the one package to reread when JAX moves."""

"""All that leans on JAX internals: the one package to reread when JAX moves."""
