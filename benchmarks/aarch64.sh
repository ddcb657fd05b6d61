#!/usr/bin/env bash
# Runs the numerical tests of the rasterizer on an emulated ARM processor (aarch64), with Python and libraries of Debian.
#   sudo benchmarks/aarch64.sh FOLDER [PYTEST ARGUMENTS ...]
# Needs Debian 12 on x86-64 with Python 3 and pip, root for apt, and 2 GB in FOLDER. It takes minutes to set up and then
# hours: emulation is 20 to 50 times slower than a processor, so times mean nothing there. docs/cpu.md has the results.
set -euo pipefail
[ $# -ge 1 ] || { sed -n 2,3p "$0"; exit 2; }
folder=$(realpath -m "$1") source=$(realpath "$(dirname "$0")/..")
shift
[ $# -gt 0 ] || set -- tests/fallback_raster/test_{against_reference,optimizer,loss,thread_pool,threads,safety}.py
root=$folder/root site=$folder/root/usr/lib/python3/dist-packages python=$folder/python

if ! [ -e "$python" ]; then
    mkdir -p "$folder"/{debs,wheels} "$site"
    dpkg --add-architecture arm64
    apt-get update -qq
    apt-get install -y -qq qemu-user-static unzip >/dev/null
    # Unpacked, not installed: nothing of the packages has to run here.
    packages=(python3.11 python3.11-minimal libpython3.11-minimal libpython3.11-stdlib libc6 libgcc-s1 libstdc++6 zlib1g
        libexpat1 libffi8 libssl3 libbz2-1.0 liblzma5 libsqlite3-0 libgomp1 libuuid1 libcrypt1)
    (cd "$folder/debs" && apt-get download -qq "${packages[@]/%/:arm64}")
    for deb in "$folder"/debs/*.deb; do dpkg-deb -x "$deb" "$root"; done
    # Newer wheels of torch for aarch64 need CUDA libraries.
    python3 -m pip download --quiet --no-deps --only-binary=:all: --dest "$folder/wheels" --python-version 3.11 \
        --implementation cp --abi cp311 --abi abi3 --abi none --platform manylinux_2_28_aarch64 \
        --platform manylinux_2_34_aarch64 --platform manylinux2014_aarch64 \
        torch==2.7.1 numpy "warp-lang>=1.19" gsplat packaging pytest pytest-timeout hypothesis attrs pluggy iniconfig \
        pygments sortedcontainers typing_extensions sympy mpmath networkx jinja2 markupsafe fsspec filelock
    for wheel in "$folder"/wheels/*.whl; do unzip -qo "$wheel" -d "$site"; done
    # Tests start children with sys.executable, and the kernel of this machine runs no program for aarch64 by itself.
    echo 'import os, sys; sys.executable = os.environ.get("EMULATED_PYTHON", sys.executable)' >"$site/emulated.pth"
    printf '#!/bin/sh\nexec qemu-aarch64-static -L %s %s/usr/bin/python3.11 "$@"\n' "$root" "$root" >"$python"
    chmod +x "$python"
fi
export EMULATED_PYTHON=$python PYTHONPATH=$source PYTHONDONTWRITEBYTECODE=1 WARP_CACHE_PATH=$folder/kernels
export PYTEST_TIMEOUT=0  # no limit, nor for the pytest that a test starts
cd "$source"
"$python" -c 'import platform; print(platform.machine())'
# The profile "ci" of hypothesis lets a test take its time when it draws inputs.
exec "$python" -m pytest -q -p no:cacheprovider --hypothesis-profile ci "$@"
