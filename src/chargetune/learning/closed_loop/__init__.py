"""Searches for theta on closed loops that can be simulated, and iterative learning from measured ones."""
