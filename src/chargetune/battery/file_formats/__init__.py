"""The files that a person writes: every key with unit, default, allowed values and one sentence, as a page and as a JSON schema."""
