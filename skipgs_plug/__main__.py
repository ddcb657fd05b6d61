"""`python -m skipgs_plug` is the command `skipgs-plug`."""

import sys

from skipgs_plug.cli import main

sys.exit(main())
