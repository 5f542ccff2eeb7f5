"""Plain torch float64 twins of the kernels."""
