"""Residual tests: what a model has left in its residuals, and their algebra."""
