#!/usr/bin/env bash
# Runs the numerical tests of the rasterizer on an emulated ARM processor (aarch64): Debian in a folder, run by qemu.
#   sudo benchmarks/aarch64.sh FOLDER [PYTEST ARGUMENTS ...]
# Needs Debian or Ubuntu, root, 6 GB in FOLDER and hours. Emulation is 20 to 50 times slower than a processor, so times mean
# nothing there. Of this script only the steps up to debootstrap were tried, which took over an hour on a busy machine.
# docs/cpu.md says which tests were run by hand, and their results.
set -euo pipefail
[ $# -ge 1 ] || { sed -n 2,3p "$0"; exit 2; }
root=$(realpath -m "$1") source=$(realpath "$(dirname "$0")/..")
shift
[ $# -gt 0 ] || set -- tests/fallback_raster/test_against_reference.py tests/fallback_raster/test_optimizer.py \
    tests/fallback_raster/test_loss.py tests/fallback_raster/test_thread_pool.py tests/fallback_raster/test_safety.py

if ! command -v debootstrap >/dev/null || ! command -v qemu-aarch64-static >/dev/null; then
    apt-get update -qq
    apt-get install -y -qq qemu-user-static debootstrap binfmt-support >/dev/null
fi
# Let the kernel run programs for aarch64 with qemu.
[ -e /proc/sys/fs/binfmt_misc/register ] || mount -t binfmt_misc binfmt_misc /proc/sys/fs/binfmt_misc
[ -e /proc/sys/fs/binfmt_misc/qemu-aarch64 ] || update-binfmts --enable qemu-aarch64

if [ ! -e "$root/usr/bin/python3" ]; then
    debootstrap --arch=arm64 --variant=minbase --include=python3,python3-venv,ca-certificates bookworm "$root"
fi
for system in proc sys; do
    mountpoint -q "$root/$system" || mount --bind "/$system" "$root/$system"
done
trap 'umount "$root/proc" "$root/sys"' EXIT
cp /etc/resolv.conf "$root/etc/resolv.conf"
mkdir -p "$root/source"
tar -C "$source" --exclude=.venv --exclude=.git -cf - . | tar -C "$root/source" -xf -
# Newer wheels of torch for aarch64 need CUDA libraries.
chroot "$root" /bin/sh -euc '
    cd /source
    [ -e /env/bin/pytest ] || {
        python3 -m venv /env
        /env/bin/pip install --quiet torch==2.7.1 numpy "warp-lang>=1.19" gsplat packaging pytest pytest-timeout hypothesis
        /env/bin/pip install --quiet --no-deps .
    }
    uname -m
    /env/bin/python -m pytest -q -p no:cacheprovider --timeout 100000 "$@"
' sh "$@"
