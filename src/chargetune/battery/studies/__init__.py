"""Charging studies: their file, how they are opened, campaigns, export."""
