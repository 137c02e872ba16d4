"""Parametric models: a structure with its parameters, and their responses and derivatives."""
