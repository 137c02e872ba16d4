"""Predictors of the model structures and their sensitivities, compiled where a compiler is there."""
