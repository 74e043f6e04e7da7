"""Tuners that see scores alone: Gaussian processes and what is expected of a theta."""
