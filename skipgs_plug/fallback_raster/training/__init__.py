"""Optimizers and the loss of training, as kernels."""
