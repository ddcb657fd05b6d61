"""Refinement in fewer iterations: which numbers a loop leaves out, and the larger steps that make up for it."""
