"""What a GPU says about the gate: one command, one scene, under eight minutes."""
