"""The method: when to skip a backward, and how a loop is told. Knows no trainer and no renderer."""
