"""The catalogue of effects that a linear model can lack, each as data plus its term."""
