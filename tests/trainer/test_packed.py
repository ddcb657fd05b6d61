"""Packed scenes survive the round trip bit for bit; damaged ones are refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from skipgs_plug.trainer import InputError, Scene, load_scene, save_packed


def test_round_trip(tmp_path: Path, tiny_scene: Scene) -> None:
    save_packed(tiny_scene, tmp_path / "scene.npz")
    loaded = load_scene(tmp_path / "scene.npz")
    assert [p.name for p in tmp_path.iterdir()] == ["scene.npz"]
    for ours, theirs in zip(loaded.train + loaded.test, tiny_scene.train + tiny_scene.test, strict=True):
        assert ours.name == theirs.name
        assert torch.equal(ours.image, theirs.image)
        assert torch.equal(ours.K, theirs.K)
        torch.testing.assert_close(ours.viewmat, theirs.viewmat, rtol=0, atol=1e-14)
    assert torch.equal(loaded.points, tiny_scene.points)
    assert loaded.scene_scale == tiny_scene.scene_scale
    assert loaded.background == tiny_scene.background


def test_damaged(tmp_path: Path, tiny_scene: Scene) -> None:
    path = tmp_path / "scene.npz"
    save_packed(tiny_scene, path)
    whole = path.read_bytes()
    for content in (whole[: len(whole) // 2], b"", b"not an archive"):
        path.write_bytes(content)
        with pytest.raises(InputError, match=r"scene\.npz is damaged or not one .*pack it again"):
            load_scene(path)
    np.savez(path, points=np.zeros((4, 3)))
    with pytest.raises(InputError, match="damaged or not one"):
        load_scene(path)
    (tmp_path / "scene.zip").write_bytes(whole)
    with pytest.raises(InputError, match="is a file but not a packed"):
        load_scene(tmp_path / "scene.zip")
