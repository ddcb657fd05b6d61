"""Assembles the C++ text of each kernel from `kernels/*.h` and from the constants that Python declares.

A file in `kernels/` defines the function of its name. A file in `kernels/lib/` defines functions that several kernels
use. Each file includes the files that it needs. Together with the constants and structs that Python declares
(`declarations.py`), each file can be read by itself. Warp takes a single text, so includes are resolved here, each file
once. `#line` directives let Clang name our file and line in error messages.
"""

import math
import re
from pathlib import Path, PurePosixPath

from . import constants
from .optimizations import OPTIMIZATIONS

KERNELS = Path(__file__).parent.parent / "kernels"

_INCLUDE = re.compile(r'^#include "([\w/]+\.h)"$', re.MULTILINE)
_PRELUDE_FILE = "lib/simd.h"  # every kernel begins with this file


def read_kernel(name: str) -> str:
    """Return the text of `kernels/<name>` with its includes resolved. Paths are relative to the including file."""
    return _read(name, {_PRELUDE_FILE})


def _read(name: str, done: set[str]) -> str:
    """Return the text of a file and of its includes, except for those already in `done`."""
    done.add(name)
    text = (KERNELS / name).read_text(encoding="utf-8").replace("#pragma once\n", "\n")
    # Relative to the package: the cache is keyed by the text, which must not depend on where the package is installed.
    file = f"skipgs_plug/fallback_raster/kernels/{name}"

    def include(match: re.Match[str]) -> str:
        included = str(PurePosixPath(name).parent / match[1])
        if included in done:
            return ""
        following = text.count("\n", 0, match.end()) + 2
        return f'{_read(included, done)}#line {following} "{file}"'

    return f'#line 1 "{file}"\n{_INCLUDE.sub(include, text)}'


def declare(values: dict[str, int | float]) -> str:
    """Return C++ definitions of constants with these names and values."""
    return "".join(
        f"static constexpr int {name} = {int(value)};\n"
        if isinstance(value, int)
        else f"static constexpr float {name} = {value!r}f;\n"
        for name, value in values.items()
    )


# The text before the constants in every kernel.
PRELUDE = read_kernel(_PRELUDE_FILE)

SHARED = {name: value for name, value in vars(constants).items() if name.isupper()} | {
    name.upper(): bit for name, bit in OPTIMIZATIONS.items()
}
assert all(math.isfinite(value) for value in SHARED.values())
