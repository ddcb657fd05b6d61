"""`skipgs-plug run`: an unmodified training script, gated, and on the CPU where there is no GPU."""

from __future__ import annotations
