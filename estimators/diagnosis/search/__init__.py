"""The search for what the linear model lacks: candidates fitted, selected, exchanged."""
