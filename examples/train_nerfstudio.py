"""Run the training command of nerfstudio's splatfacto, unedited and with a gate.

    python examples/train_nerfstudio.py -- splatfacto --data data/garden

Put options of the gate (see `skipgs-plug run --help`) before `--`, and options of the command after it.
"""

import sys

from _checkout import run_module

sys.exit(run_module("nerfstudio", "nerfstudio.scripts.train"))
