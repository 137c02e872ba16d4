"""From a residual to its cause: detection, attribution, the augmented model, the error before and after."""
