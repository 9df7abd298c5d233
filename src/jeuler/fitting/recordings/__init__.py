"""Recordings as apps and loggers write them: what a file holds, what its columns mean, how its clock runs."""
