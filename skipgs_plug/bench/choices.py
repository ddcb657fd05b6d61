"""What an option of the bench may be."""

from typing import Literal

Clock = Literal["wall", "processor"]
