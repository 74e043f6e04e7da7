"""Checks of a controller before it is tuned: of its formulation, its closed loop, its theta and its plant."""
