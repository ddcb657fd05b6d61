"""Measures the gate on a GPU: one command, one scene, under eight minutes."""
