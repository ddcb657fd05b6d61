"""nerfstudio's splatfacto, its own command, unedited and gated.

    python examples/train_nerfstudio.py -- splatfacto --data data/garden

Options of the gate (`skipgs-plug run --help`) stand before `--`, options of the command after it.
"""

import sys

from _checkout import run_module

sys.exit(run_module("nerfstudio", "nerfstudio.scripts.train"))
