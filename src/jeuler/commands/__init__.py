"""What the shell does: ``python -m jeuler``."""

"""What the shell does: ``python -m jeuler``."""
