"""Possible values of the bench's options."""

from typing import Literal

Clock = Literal["wall", "processor"]
