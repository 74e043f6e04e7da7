"""The store: trials and traces in SQLite or PostgreSQL, with migration, checks and salvage."""
