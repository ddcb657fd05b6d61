"""The text of the kernels: C++ in `kernels/*.h`, joined here, with the constants that Python shares.

A file in `kernels/` defines the function of its name, one in `kernels/lib/` what several of them use. Each includes
the files that it needs and can be read by itself, given the constants and structs that Python declares
(`declarations.py`). Warp takes one text: includes are put in place here, each file once. `#line` lets Clang name
our file and line where something does not compile.
"""

import math
import re
from pathlib import Path, PurePosixPath

from . import constants
from .optimizations import OPTIMIZATIONS

KERNELS = Path(__file__).parent.parent / "kernels"

_INCLUDE = re.compile(r'^#include "([\w/]+\.h)"$', re.MULTILINE)
_FIRST = "lib/simd.h"  # which precedes everything else in every kernel


def read_kernel(name: str) -> str:
    """Return the text of `kernels/<name>` with its includes in place; a path in one starts at the file's own folder."""
    return _read(name, {_FIRST})


def _read(name: str, done: set[str]) -> str:
    """Return the text of a file, and of those it includes that are not `done`."""
    done.add(name)
    text = (KERNELS / name).read_text(encoding="utf-8").replace("#pragma once\n", "\n")
    # Relative to the package: the text decides which cached build fits, wherever the package lies.
    file = f"skipgs_plug/fallback_raster/kernels/{name}"

    def include(match: re.Match[str]) -> str:
        included = str(PurePosixPath(name).parent / match[1])
        if included in done:
            return ""
        following = text.count("\n", 0, match.end()) + 2
        return f'{_read(included, done)}#line {following} "{file}"'

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
PRELUDE = read_kernel(_FIRST)

SHARED = {name: value for name, value in vars(constants).items() if name.isupper()} | {
    name.upper(): bit for name, bit in OPTIMIZATIONS.items()
}
assert all(math.isfinite(value) for value in SHARED.values())
