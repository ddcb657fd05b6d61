"""Values that an option of the bench may have."""

from typing import Literal

Clock = Literal["wall", "processor"]
