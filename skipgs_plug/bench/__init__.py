"""The comparison behind `skipgs-plug bench`: one snapshot per seed, refined under each policy and its controls.

Reading order: `policies` (what is compared), `refine` (one run), `runner` (all of them), `summary` (the table).
"""
