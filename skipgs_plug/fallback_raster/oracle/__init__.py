"""The renderer in plain torch and float64 that tests compare the kernels with."""
