"""Recordings of any sensor, one or several, as one least-squares problem."""
