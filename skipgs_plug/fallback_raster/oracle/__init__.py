"""The reference renderer in plain torch, with which tests compare the kernels in float64."""
