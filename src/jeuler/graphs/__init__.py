"""Sums over the edges of a graph, whatever they mean: knows no physics."""

"""Sums over the edges of a graph, whatever they mean: knows no physics."""
