"""Inria 3DGS and 3DGS-MCMC grow on cameras of half the size, and all other code finds the cameras as they are."""

import ast
from types import SimpleNamespace

import pytest
import torch
from lookalikes import inria, mcmc
from lookalikes.splats import draw, make_cameras, new_log, options, photo_loss

from skipgs_plug import SkipGate, SkipGSError
from skipgs_plug.adapters.half_size_cameras import IMAGES, HalfSizeCameras
from skipgs_plug.adapters.inria import Inria
from skipgs_plug.core.pace.growing import Growing

FULL, HALF = (24, 32), (12, 16)
GROWS, LAST = 20, 60


@pytest.fixture
def sizes(monkeypatch):
    """Sizes [H, W] of the training renders by iteration, and of all other renders."""
    seen = SimpleNamespace(training={}, others=set())

    def noted_loss(image, camera):
        assert image.shape == camera.original_image.shape
        seen.training[inria.log.now] = tuple(image.shape[1:])
        return photo_loss(image, camera)

    def noted_draw(camera, values, training=True):
        drawn = draw(camera, values, training)
        if not torch.is_grad_enabled():
            seen.others.add(tuple(drawn["render"].shape[1:]))
        return drawn

    for module in (inria, mcmc):
        monkeypatch.setattr(module, "photo_loss", noted_loss)
        monkeypatch.setattr(module, "draw", noted_draw)
    return seen


def train(module, cameras, **settings):
    new_log()
    data = SimpleNamespace(model_path="output", cameras=cameras, white_background=False)
    with SkipGate(module, **settings) as gate:
        module.training(data, options(LAST, LAST, {}), None)
    return gate


def half_sizes(seen, size=HALF):
    return sorted(step for step, shape in seen.training.items() if shape == size)


@pytest.mark.parametrize("module", [inria, mcmc])
def test_the_scene_grows_on_cameras_of_half_the_size(module, sizes):
    cameras = make_cameras(scale=2)
    before = [camera.original_image for camera in cameras]
    gate = train(module, cameras, share=0.9, half_size=True)
    # The settings are known from the first iteration on, and the loop from the second.
    assert half_sizes(sizes) == [step for step in sizes.training if 1 < step < GROWS]
    assert set(sizes.training.values()) == {FULL, HALF} and sizes.others <= {FULL}
    assert gate.report()["growing"]["half_size_until"] == GROWS
    for camera, image in zip(cameras, before, strict=True):
        assert camera.original_image is image and (camera.image_height, camera.image_width) == FULL


def test_an_evaluation_in_between_sees_the_cameras_as_they_are(sizes):
    train(inria, make_cameras(scale=2), share=0.9, half_size=True)
    assert sizes.others == {FULL}


@pytest.mark.parametrize("smooth", [True, False])
def test_auto_asks_the_photographs(sizes, smooth):
    cameras = make_cameras(scale=2)
    for camera in cameras if smooth else ():
        camera.original_image = torch.linspace(0, 1, FULL[1]).expand(3, *FULL).clone()
    gate = train(inria, cameras, share="auto")
    assert bool(half_sizes(sizes)) == smooth
    assert (gate.report()["growing"]["half_size_psnr"] > 32) == smooth


def test_a_scene_with_many_new_gaussians_grows_on_cameras_of_their_own_size(monkeypatch, sizes):
    monkeypatch.setattr(Growing, "_grows_strongly", property(lambda phase: max(sizes.training) >= 12))
    gate = train(inria, make_cameras(scale=2), share=1.0, half_size=True)
    first_event = 15  # of those that come after iteration 12
    assert half_sizes(sizes) == list(range(2, first_event))
    assert gate.report()["growing"]["half_size_until"] == first_event


def test_half_size_can_be_refused(sizes):
    cameras = make_cameras(scale=2)
    for camera in cameras:
        camera.original_image = torch.zeros(3, *FULL)
    train(inria, cameras, share="auto", half_size=False)
    assert not half_sizes(sizes)


def test_a_released_gate_leaves_the_cameras_as_they_were(sizes, monkeypatch):
    show = HalfSizeCameras._show

    def fails(self, camera):
        show(self, camera)
        if inria.log.now == 7:
            raise RuntimeError("out of memory")

    monkeypatch.setattr(HalfSizeCameras, "_show", fails)
    cameras = make_cameras(scale=2)
    with pytest.warns(RuntimeWarning, match="out of memory"):
        train(inria, cameras, share=1.0, half_size=True)
    assert half_sizes(sizes) == list(range(2, 7)) and len(sizes.training) == LAST
    assert all((camera.image_height, camera.image_width) == FULL for camera in cameras)


AFTER = """
def training(cameras):
    for iteration in range(60):
        camera = cameras[iteration]
        image = render(camera, gaussians)["render"]
        loss = (image - camera.original_image).abs().mean()
"""
BEFORE = AFTER.replace("image = render", "pixels = camera.image_width * camera.image_height\n        image = render")
ELSEWHERE = AFTER.replace("for iteration", "edges = [edge(view.original_image) for view in cameras]\n    for iteration")


def shown(camera, source=AFTER, may_halve=True):
    hooks = SimpleNamespace(may_halve=may_halve, at_half_size=True, on_detach=lambda label, undo: None)
    return HalfSizeCameras.of(hooks, [camera], SimpleNamespace(syntax=ast.parse(source)), ("render",))


@pytest.mark.parametrize("odd", ["too small", "an unknown image", "no photograph"])
def test_cameras_that_cannot_be_halved_are_left_alone(odd):
    camera = make_cameras(scale=1 if odd == "too small" else 2)[0]
    if odd == "an unknown image":
        camera.normals = torch.zeros(3, *FULL)
    if odd == "no photograph":
        del camera.original_image
    assert shown(camera) is None


def test_a_loop_that_reads_a_camera_before_its_render_is_left_alone():
    camera = make_cameras(scale=2)[0]
    assert shown(camera) is not None
    assert shown(camera, BEFORE) is None and shown(camera, ELSEWHERE) is None
    assert shown(camera, may_halve=False) is None


def test_all_images_of_a_camera_are_halved():
    camera = make_cameras(scale=2)[0]
    camera.alpha_mask, camera.invdepthmap = torch.ones(1, *FULL), torch.rand(1, *FULL)
    camera.depth_mask = torch.zeros(1, *FULL)
    cameras = shown(camera)
    cameras.rendered(camera, training=True)
    assert all(getattr(camera, name).shape[1:] == HALF for name in IMAGES)
    cameras.rendered(camera, training=False)
    assert all(getattr(camera, name).shape[1:] == FULL for name in IMAGES)


@pytest.mark.parametrize(("known", "scale"), [(True, 1), (False, 2)])
def test_asking_for_the_impossible_is_refused_before_training(known, scale, monkeypatch):
    monkeypatch.setattr(Inria, "shows_half_size", known)
    with pytest.raises(SkipGSError, match="half_size is not possible here"):
        train(inria, make_cameras(scale=scale), share=0.9, half_size=True)
    assert inria.log.now <= 2
