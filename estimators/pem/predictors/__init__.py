"""Predictors of the model structures and their sensitivities, compiled once for all orders."""
