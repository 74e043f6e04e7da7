"""Tuners without a plant model: Bayesian optimisation on the scores of trials, or on what passed in windows of each trial."""
