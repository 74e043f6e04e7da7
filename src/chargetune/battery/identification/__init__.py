"""From a cycler's records to a cell: files, pulses, fits."""
