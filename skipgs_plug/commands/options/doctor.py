"""Usage of `skipgs-plug doctor`, which has no options. It does not need tyro, which may be missing."""

from __future__ import annotations

USAGE = "usage: skipgs-plug doctor\n\nSay which backends and extras work here, and how to get the rest."


def parse(argv: list[str]) -> None:
    if argv:
        print(USAGE)
        raise SystemExit(0 if argv[0] in ("-h", "--help") else 2)
