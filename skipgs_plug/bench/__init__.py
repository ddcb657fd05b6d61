"""The comparison behind `skipgs-plug bench`: one snapshot per seed, refined under each policy and its controls.

Reading order: `policies` (the comparison), `refine` (one run), `runner` (all runs), `summary` (the table).
"""
