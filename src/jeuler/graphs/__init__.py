"""Sums over the edges of a graph, whatever they mean: knows no physics."""
