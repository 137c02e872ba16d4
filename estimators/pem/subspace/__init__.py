"""State-space models by subspace methods, with first-order errors."""
