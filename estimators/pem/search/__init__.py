"""The search for the global optimum of a prediction-error criterion."""
