"""Figures of studies, checks, comparisons and certificates."""
