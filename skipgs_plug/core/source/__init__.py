"""Reads the source code of training loops: the iterations that a loop needs, and the functions that it calls."""
