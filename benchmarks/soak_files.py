"""Mutated scene, image, PLY, checkpoint and state files. Each must be refused with one sentence, or load as valid data.

    from benchmarks.soak_files import run
    run(count=20_000, seed=7)

Seed and number determine a case, so `run(count=1, seed=7, first=1234)` repeats one. Cases run in child processes with
limited memory. A crash, a hang, an unexpected exception, an invalid scene or a new file is reported with seed, number,
file and mutation.
"""

from __future__ import annotations

import faulthandler
import json
import random
import resource
import struct
import subprocess
import sys
import tempfile
import traceback
from collections import Counter
from pathlib import Path

from benchmarks.soak_sources import Source, write_sources
from skipgs_plug import SkipGSError
from skipgs_plug.trainer import InputError

ROOT = Path(__file__).parents[1]
MEMORY = 1 << 30  # bytes of address space that a case may add to that of the loaded libraries
SECONDS = 20.0  # seconds after which the child process ends itself; a case takes milliseconds
BATCH = 500  # cases of one child process
# Values that counts, sizes and coordinates rarely have.
NUMBERS = (0, 1, -1, 127, 255, 2**31 - 1, -(2**31), 2**32 - 1, 2**40, 2**62, -(2**63), 2**64 - 1)
REALS = (0.0, -1.0, 1e-300, 1e300, float("nan"), float("inf"), 1e20)
TOKENS = (
    "nan",
    "1e999",
    "-1",
    "0",
    "9" * 5000,
    "[" * 20_000,
    "../x",
    "/",
    "\\",
    "\0",
    "null",
    '""',
    "{}",
    " ",
    "\ud800",
)


def run(count: int, seed: int, first: int = 0, batch: int = BATCH) -> dict[str, int]:
    """Run cases `first` to `first + count - 1` and count their outcomes: `refused` and `loaded`.

    Raises:
        AssertionError: A case was neither. All such cases are listed.
    """
    outcomes: Counter[str] = Counter()
    failures: list[str] = []
    last = first + count
    while first < last:
        end = min(first + batch, last)
        done = run_batch(seed, first, end, outcomes, failures)
        if done < end:  # the child died in this case: continue with the next
            done += 1
        first = done
    if failures:
        raise AssertionError(f"{len(failures)} of {count} mutated files (seed {seed}):\n" + "\n".join(failures))
    return dict(outcomes)


def run_batch(seed: int, first: int, end: int, outcomes: Counter[str], failures: list[str]) -> int:
    """Run cases in one child process. Returns the number of the case in which it died, or `end`."""
    done = first
    process = subprocess.run(
        [sys.executable, "-c", child_command(seed, first, end)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        errors="replace",
    )
    lines = [line for line in process.stdout.splitlines() if line.startswith("{")]
    if not lines:
        raise RuntimeError(f"The unmutated files do not load:\n{process.stderr}")
    for line in lines[1:]:
        result = json.loads(line)
        done = result["case"] + 1
        outcomes[result["outcome"]] += 1
        if result["outcome"] == "failed":
            failures.append(f"case {result['case']}: {result['what']}: {result['why']}")
    if done < end:
        what = Case(seed, done).what
        failures.append(f"case {done}: {what}: ended with {process.returncode}: {process.stderr.strip()[-800:]}")
    return done


def child_command(seed: int, first: int, end: int) -> str:
    return f"from benchmarks.soak_files import child; child({seed}, {first}, {end})"


def child(seed: int, first: int, end: int) -> None:
    """Run cases in this process and print one line of JSON for each."""
    with tempfile.TemporaryDirectory() as name:
        sources = write_sources(Path(name))
        for source in sources.values():
            source.load()  # loads libraries and starts threads before memory is limited
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        limit = pages * resource.getpagesize() + MEMORY
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
        print("{}", flush=True)
        for number in range(first, end):
            case = Case(seed, number)
            faulthandler.dump_traceback_later(SECONDS, exit=True)
            print(json.dumps({"case": number, "what": case.what, **case.run(sources[case.source])}), flush=True)


class Case:
    """One mutation of one file, chosen by seed and number."""

    def __init__(self, seed: int, number: int) -> None:
        self.random = random.Random(f"{seed}:{number}")
        self.source, self.file = self.random.choice(TARGETS)
        mutations = TEXT if self.file.endswith((".txt", ".json")) and self.random.random() < 0.7 else BYTES
        self.mutations = [self.random.choice(mutations) for _ in range(self.random.choice((1, 1, 1, 2, 4)))]
        self.what = f"{self.source}/{self.file} by {', '.join(m.__name__ for m in self.mutations)}"

    def run(self, source: Source) -> dict[str, str]:
        """Mutate the file, load it, and restore it."""
        content = source.files[self.file]
        for mutate in self.mutations:
            content = mutate(content, self.random)
        path = source.folder / self.file
        path.write_bytes(content)
        outcome = {"outcome": "loaded"}
        try:
            source.load()
        except (InputError, SkipGSError) as error:
            outcome = {"outcome": "refused"}
            if not str(error) or "\n" in str(error).strip() or len(str(error)) > 2000:
                outcome = {"outcome": "failed", "why": f"not one sentence: {str(error)[:500]!r}"}
        except BaseException:
            outcome = {"outcome": "failed", "why": traceback.format_exc()[-1500:]}
        path.write_bytes(source.files[self.file])
        if source.list() != source.listing:
            outcome = {"outcome": "failed", "why": f"left {sorted(set(source.list()) - set(source.listing))}"}
        return outcome


def truncate(content: bytes, rng: random.Random) -> bytes:
    return content[: rng.randrange(len(content) + 1)]


def flip_bits(content: bytes, rng: random.Random) -> bytes:
    out = bytearray(content)
    for _ in range(rng.choice((1, 2, 8, 64))):
        if out:
            out[rng.randrange(len(out))] ^= 1 << rng.randrange(8)
    return bytes(out)


def overwrite(content: bytes, rng: random.Random) -> bytes:
    """Overwrite some bytes, often near the start, with a number from NUMBERS or REALS."""
    if rng.random() < 0.5:
        kind, value = rng.choice("BHIQ"), rng.choice(NUMBERS)
        size = struct.calcsize(kind)
        data = (value % (1 << 8 * size)).to_bytes(size, rng.choice(("little", "big")))
    else:
        data = struct.pack(rng.choice(("<d", "<f")), rng.choice([v for v in REALS if abs(v) < 1e38 or v != v]))
    at = rng.randrange(min(len(content), rng.choice((16, 200, 1 << 30))) + 1)
    return content[:at] + data + content[at + len(data) :]


def insert(content: bytes, rng: random.Random) -> bytes:
    at = rng.randrange(len(content) + 1)
    return content[:at] + rng.randbytes(rng.choice((1, 4, 100))) + content[at:]


def cut(content: bytes, rng: random.Random) -> bytes:
    at = rng.randrange(len(content) + 1)
    return content[:at] + content[at + rng.choice((1, 8, 100)) :]


def repeat(content: bytes, rng: random.Random) -> bytes:
    at, end = sorted(rng.randrange(len(content) + 1) for _ in range(2))
    return content[:end] + content[at:]


def replace_token(content: bytes, rng: random.Random) -> bytes:
    """Replace one number, word or string of a text."""
    text = content.decode("utf-8", "replace")
    words = text.replace(",", " , ").replace(":", " : ").split(" ")
    words[rng.randrange(len(words))] = rng.choice(TOKENS)
    return " ".join(words).encode("utf-8", "surrogatepass")


def drop_line(content: bytes, rng: random.Random) -> bytes:
    lines = content.split(b"\n")
    del lines[rng.randrange(len(lines))]
    return b"\n".join(lines)


BYTES = (truncate, flip_bits, overwrite, overwrite, insert, cut, repeat)
TEXT = (replace_token, replace_token, replace_token, drop_line)

COLMAP = ("cameras", "images", "points3D")
TARGETS = [  # (source, file); the binary model twice, because users receive such files from others
    *(("binary", f"sparse/0/{name}.bin") for name in COLMAP * 2),
    *(("binary", f"sparse/0/{name}.bin") for name in ("rigs", "frames")),
    *(("text", f"sparse/0/{name}.txt") for name in COLMAP),
    ("text", "images/view_001.png"),
    ("text", "masks/view_002.png"),
    ("blender", "transforms_train.json"),
    ("blender", "view_001.png"),
    ("nerfstudio", "transforms.json"),
    ("nerfstudio", "transforms.json"),
    ("nerfstudio", "sparse_pc.ply"),
    ("nerfstudio", "view_001.png"),
    ("packed", "scene.npz"),
    ("packed", "scene.npz"),
    *(("states", name) for name in ("ckpt.pt", "chkpnt.pth.skipgs.json") * 2),
    *(("images", f"picture.{suffix}") for suffix in ("png", "jpg", "tif", "webp", "gif", "bmp")),
    *(("ply", f"{name}.ply") for name in ("model", "model", "text", "points")),
]
