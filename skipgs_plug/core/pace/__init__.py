"""The pace of a run: which iterations a loop leaves out, which densification events, and how long steps are."""
