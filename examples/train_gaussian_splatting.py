"""The pip package gaussian-splatting, its own command, unedited and gated.

    python examples/train_gaussian_splatting.py -- -s data/garden -d output/garden -i 30000 --mode densify

Options of the gate (`skipgs-plug run --help`) stand before `--`, options of the command after it.
"""

import sys

from _checkout import run_module

sys.exit(run_module("step_trainer", "gaussian_splatting.train"))
