"""How probable a violation is, by fresh episodes on plants that differ."""
