"""What the record itself shows: faults of the measurement, copied rows, what is left, held-out blocks."""
