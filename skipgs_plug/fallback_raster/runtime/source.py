"""The text of the kernels: C++ in `kernels/*.h`, joined here, with the constants that Python shares.

A kernel's file is what one of its workers does with items `[first, last)`. It may include the headers in `kernels/lib`;
`lib/simd.h` comes first in any case. `#line` lets Clang name our file and line where something does not compile.
"""

import math
import re
from pathlib import Path, PurePosixPath

from . import constants
from .optimizations import OPTIMIZATIONS

KERNELS = Path(__file__).parent.parent / "kernels"

_INCLUDE = re.compile(r'^#include "([\w/]+\.h)"$', re.MULTILINE)


def read_kernel(name: str) -> str:
    """Return the text of `kernels/<name>` with its includes in place; a path in one starts at the file's own folder."""
    text = (KERNELS / name).read_text(encoding="utf-8")
    # Relative to the package: the text decides which cached build fits, wherever the package lies.
    file = f"skipgs_plug/fallback_raster/kernels/{name}"

    def include(match: re.Match[str]) -> str:
        following = text.count("\n", 0, match.end()) + 2
        return f'{read_kernel(str(PurePosixPath(name).parent / match[1]))}#line {following} "{file}"'

    return f'#line 1 "{file}"\n{_INCLUDE.sub(include, text)}'


def declare(values: dict[str, int | float]) -> str:
    """C++ constants of these names and values."""
    return "".join(
        f"static constexpr int {name} = {int(value)};\n"
        if isinstance(value, int)
        else f"static constexpr float {name} = {value!r}f;\n"
        for name, value in values.items()
    )


# What precedes the constants in every kernel.
PRELUDE = read_kernel("lib/simd.h")

SHARED = {name: value for name, value in vars(constants).items() if name.isupper()} | {
    name.upper(): bit for name, bit in OPTIMIZATIONS.items()
}
assert all(math.isfinite(value) for value in SHARED.values())
