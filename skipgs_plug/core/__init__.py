"""The method: when to skip a backward pass, and how to act on a loop. It knows no trainer and no renderer."""
