"""The twin: a model of the plant whose unknowns are learnt from whole traces."""
