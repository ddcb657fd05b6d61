"""Predict time, number of Gaussians and memory of whole runs from half a minute of training."""
