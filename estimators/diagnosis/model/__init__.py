"""The augmented model: a linear part and effects around and inside it, simulated, differentiated and fitted."""
