"""Allowed values of the options of structure from motion."""

from typing import Literal

Matching = Literal["auto", "exhaustive", "sequential"]  # which pairs of photographs are compared
Mapping = Literal["auto", "incremental", "global"]  # how photographs are placed: one after another, or all at once
