"""The case study of Hirt et al. (ADCHEM 2024): its studies, and which of its claims hold."""
