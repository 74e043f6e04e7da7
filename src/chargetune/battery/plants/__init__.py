"""Plants of charging studies beside the cell's own circuit."""
