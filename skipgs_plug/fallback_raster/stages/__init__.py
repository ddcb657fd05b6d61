"""The stages of rendering: project, bin, blend, spherical harmonics, and their adjoints. Each is a few kernels."""
