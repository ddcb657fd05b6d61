"""Values that the options of structure from motion may have."""

from typing import Literal

Matching = Literal["auto", "exhaustive", "sequential"]  # which photographs are compared
Mapping = Literal["auto", "incremental", "global"]  # placed one after another, or all at once
