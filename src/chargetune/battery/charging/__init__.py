"""The charging problem: cell, controller, limits, theta, one charge and the verdict on it."""
