"""Captures larger than the memory for photographs train as others do, within that memory."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from PIL import Image
from scene_folders import write_colmap

from skipgs_plug.limits import UNKNOWN, V1, V2, free_memory
from skipgs_plug.trainer import InputError, Scene, TrainConfig, Trainer, load_scene
from skipgs_plug.trainer.image_store import ImageStore, StreamedView, one_by_one

PICTURE = 32 * 24 * 4  # bytes of a photograph and its mask


@pytest.fixture
def folder(tmp_path: Path, tiny_scene: Scene) -> Path:
    """A scan with a mask for each photograph, whose first rows do not count."""
    folder = write_colmap(tiny_scene, tmp_path / "scan")
    for path in sorted((folder / "images" / "cam").iterdir()):
        mask = Image.new("L", (32, 24), 255)
        mask.paste(0, (0, 0, 32, 3))
        (folder / "masks" / "cam").mkdir(parents=True, exist_ok=True)
        mask.save(folder / "masks" / "cam" / f"{path.name}.png")
    return folder


def trained(scene: Scene, config: TrainConfig) -> Trainer:
    trainer = Trainer(config, scene)
    trainer.train(progress=False)
    return trainer


@pytest.mark.parametrize("pictures", [0.5, 6])
def test_a_streamed_capture_trains_bit_by_bit_as_one_in_memory(
    folder: Path, tiny_config: TrainConfig, tmp_path: Path, pictures: float
) -> None:
    config = dataclasses.replace(tiny_config, exposure=True)
    whole, streamed = load_scene(folder), load_scene(folder, images=ImageStore(round(pictures * PICTURE)))
    assert not any(isinstance(view, StreamedView) for view in whole.train + whole.test)
    count = sum(isinstance(view, StreamedView) for view in streamed.train + streamed.test)
    assert count == 10 - int(0.75 * pictures)
    for ours, theirs in zip(one_by_one(streamed.test), whole.test, strict=True):
        assert torch.equal(ours.image, theirs.image) and (ours.width, ours.height) == (32, 24)
        assert ours.mask is not None and theirs.mask is not None and torch.equal(ours.mask, theirs.mask)
    expected = trained(whole, config)
    half = Trainer(config, streamed)
    half.train(until=25, progress=False)
    half.save_checkpoint(tmp_path / "half.pt")
    resumed = Trainer(config, load_scene(folder, images=ImageStore(PICTURE)))
    resumed.load_checkpoint(tmp_path / "half.pt")
    resumed.train(progress=False)
    for name, parameter in expected.splats.items():
        assert torch.equal(parameter, resumed.splats[name])
    assert expected.evaluate() == resumed.evaluate()


def test_photographs_are_decoded_before_their_turn_and_memory_is_bounded(
    folder: Path, tiny_config: TrainConfig
) -> None:
    store = ImageStore(12 * PICTURE // 3)  # room for three that stay and one that is decoded ahead
    trainer = Trainer(tiny_config, load_scene(folder, images=store))
    most, unexpected = 0, 0

    def look(_: object) -> None:
        nonlocal most, unexpected
        most = max(most, len(store._ahead))
        unexpected += store._last is not None

    trainer.on_step = look
    trainer.train(progress=False)
    assert store._resident <= 3 * PICTURE and 1 <= most <= 2  # the photograph in use and the ones ahead
    assert unexpected == 0
    assert not store._ahead


def test_a_damaged_photograph_is_named_before_training(folder: Path) -> None:
    path = sorted((folder / "images" / "cam").iterdir())[-1]
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(InputError, match=path.name):
        load_scene(folder, images=ImageStore(PICTURE))


def test_one_that_is_damaged_later_is_named(folder: Path) -> None:
    scene = load_scene(folder, images=ImageStore(0))
    view = scene.train[0]
    (folder / "images" / view.name).write_bytes(b"nothing")
    with pytest.raises(InputError, match=Path(view.name).name):
        _ = view.image


def test_a_mask_that_leaves_nothing_is_refused(folder: Path) -> None:
    path = sorted((folder / "masks" / "cam").iterdir())[3]
    Image.new("L", (32, 24), 0).save(path)
    with pytest.raises(InputError, match="leaves no pixel"):
        load_scene(folder, images=ImageStore(0))


@pytest.fixture
def write(tmp_path: Path) -> Callable[[str, str], None]:
    """A function that writes a file of the kernel."""

    def write(name: str, text: str) -> None:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)

    return write


def test_free_memory_is_what_the_control_groups_leave(tmp_path: Path, write: Callable[[str, str], None]) -> None:
    assert free_memory(tmp_path) == UNKNOWN
    write("proc/meminfo", "MemTotal: 9000000 kB\nMemAvailable:  8000000 kB\n")
    assert free_memory(tmp_path) == 8_192_000_000
    write("sys/fs/cgroup/memory.max", "max\n")
    write("sys/fs/cgroup/memory.current", "1000\n")
    assert free_memory(tmp_path) == 8_192_000_000
    write("sys/fs/cgroup/memory.max", "5000\n")
    assert free_memory(tmp_path) == 4000
    write("sys/fs/cgroup/memory/memory.limit_in_bytes", "2500\n")
    write("sys/fs/cgroup/memory/memory.usage_in_bytes", "1000\n")
    assert free_memory(tmp_path) == 1500
    write("sys/fs/cgroup/memory/memory.usage_in_bytes", "3000\n")
    assert free_memory(tmp_path) == 1


@pytest.mark.parametrize(
    ("listed", "folder", "limit", "used", "cache"),
    [
        ("0::/user.slice/job", "", V2.limit, V2.used, V2.cache),
        ("7:cpu,memory:/user.slice/job", "memory/", V1.limit, V1.used, V1.cache),
    ],
)
def test_files_in_memory_are_free_and_any_group_around_the_process_bounds_it(
    tmp_path: Path, write: Callable[[str, str], None], listed: str, folder: str, limit: str, used: str, cache: str
) -> None:
    write("proc/meminfo", "MemAvailable:  8000000 kB\n")
    write("proc/self/cgroup", f"12:pids:/\n{listed}\n")
    group = f"sys/fs/cgroup/{folder}user.slice/"
    write(f"{group}{limit}", "16000\n")
    write(f"{group}{used}", "16000\n")
    assert free_memory(tmp_path) == 1
    write(f"{group}memory.stat", f"anon 1000\n{cache} 15000\n")
    assert free_memory(tmp_path) == 15000
    write(f"{group}job/{limit}", "9000\n")  # the inner one has less left
    write(f"{group}job/{used}", "2000\n")
    assert free_memory(tmp_path) == 7000
