"""Stages of rendering, each a few kernels: project, bin, blend, spherical harmonics, and their adjoints."""
