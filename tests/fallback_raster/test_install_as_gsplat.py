"""install_as_gsplat replaces gsplat's function in all its modules, and restores it."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Iterator
from typing import Any

import pytest
import torch
from raster_scenes import random_scene

from skipgs_plug.fallback_raster import install_as_gsplat, rasterization

gsplat: Any = pytest.importorskip("gsplat")


@pytest.fixture(autouse=True)
def original() -> Iterator[Any]:
    """gsplat's own function, which every test must restore."""
    before = gsplat.rasterization
    assert before is not rasterization
    yield before
    assert gsplat.rasterization is before
    assert gsplat.rendering.rasterization is before


def test_code_written_for_gsplat_runs() -> None:
    program = "from gsplat import rasterization as r\nfrom gsplat.rendering import rasterization as s\n"
    names: dict[str, Any] = {}
    with install_as_gsplat():
        exec(program, names)
        assert names["r"] is names["s"] is gsplat.rasterization is rasterization
        image, alpha, info = gsplat.rasterization(**random_scene(n=20))
    assert image.shape == (1, 37, 44, 3) and alpha.shape == (1, 37, 44, 1)
    assert torch.isfinite(image).all() and image.any()
    assert info["n_cameras"] == 1


def test_positional_arguments_stand_where_gsplat_has_them(original: Any) -> None:
    theirs = list(inspect.signature(original).parameters)
    ours = inspect.signature(rasterization).parameters.values()
    positional = [p.name for p in ours if p.kind is p.POSITIONAL_OR_KEYWORD]
    assert positional == theirs[: len(positional)]
    assert "rasterize_mode" in positional


def test_plain_call_and_undo(original: Any) -> None:
    installation = install_as_gsplat()
    assert gsplat.rasterization is rasterization
    installation.undo()
    assert gsplat.rasterization is original


def test_nested_installations_end_with_the_last() -> None:
    with install_as_gsplat():
        with install_as_gsplat():
            pass
        assert gsplat.rasterization is rasterization


def test_undo_in_any_order_and_twice() -> None:
    first, second = install_as_gsplat(), install_as_gsplat()
    first.undo()
    first.undo()
    assert gsplat.rendering.rasterization is rasterization
    second.undo()


def test_an_error_inside_the_block_restores() -> None:
    with pytest.raises(KeyError), install_as_gsplat():
        raise KeyError


def test_a_later_patch_of_somebody_else_is_left_alone(original: Any) -> None:
    other = object()
    with install_as_gsplat():
        gsplat.rasterization = other
    assert gsplat.rasterization is other
    gsplat.rasterization = original


def test_without_gsplat_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gsplat", None)
    with pytest.raises(ImportError, match="pip install"):
        install_as_gsplat()
