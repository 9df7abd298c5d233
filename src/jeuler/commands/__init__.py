"""What the shell does: ``python -m jeuler``."""
