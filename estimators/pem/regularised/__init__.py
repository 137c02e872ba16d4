"""Impulse responses under a kernel, its hyperparameters by marginal likelihood."""
