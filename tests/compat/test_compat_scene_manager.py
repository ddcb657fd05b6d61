"""The stand-in for another project's SceneManager reads files written by COLMAP."""

import numpy as np
import pytest

pytest.importorskip("PIL.Image")  # before pycolmap: the other order crashes Python later
pycolmap = pytest.importorskip("pycolmap")

from skipgs_plug.compat import serve  # noqa: E402

CAMERAS = "1 OPENCV 64 48 50 51 32 24 0.1 0.2 0.3 0.4\n2 SIMPLE_PINHOLE 64 48 50 32 24\n"
IMAGES = "3 0.5 0.5 0.5 0.5 1 2 3 1 a.png\n1.5 2.5 7 3.5 4.5 -1\n4 1 0 0 0 0 0 1 2 b.png\n8 9 7\n"
POINTS = "7 1 2 3 10 20 30 0.5 3 0 4 0\n"


@pytest.fixture
def model(tmp_path):
    for name, text in (("cameras", CAMERAS), ("images", IMAGES), ("points3D", POINTS)):
        (tmp_path / f"{name}.txt").write_text(text)
    return str(tmp_path)


def test_model_is_read_as_gsplats_parser_asks_for_it(model):
    pytest.importorskip("gsplat")
    had = hasattr(pycolmap, "SceneManager")
    with serve("gsplat"):
        from pycolmap import SceneManager

        manager = SceneManager(model)
        manager.load_cameras(), manager.load_images(), manager.load_points3D()
    assert hasattr(pycolmap, "SceneManager") == had
    bent, plain = manager.cameras[1], manager.cameras[2]
    assert (bent.camera_type, plain.camera_type) == (4, 0)  # gsplat compares with this value
    assert (bent.fx, bent.fy, bent.cx, bent.cy, bent.width, bent.height) == (50, 51, 32, 24, 64, 48)
    assert (bent.k1, bent.k2, bent.p1, bent.p2) == (0.1, 0.2, 0.3, 0.4)
    assert (plain.fx, plain.fy, plain.cx, plain.cy) == (50, 50, 32, 24)
    image = manager.images[3]
    assert (image.name, image.camera_id, image.tvec.tolist()) == ("a.png", 1, [1, 2, 3])
    # A rotation by 120 degrees about (1, 1, 1) permutes the axes.
    assert np.allclose(image.R(), [[0, 0, 1], [1, 0, 0], [0, 1, 0]])
    assert manager.name_to_image_id == {"a.png": 3, "b.png": 4}
    assert manager.points3D.tolist() == [[1, 2, 3]] and manager.point3D_colors.tolist() == [[10, 20, 30]]
    assert manager.point3D_errors.shape == (1,) and manager.point3D_id_to_point3D_idx == {7: 0}
    assert manager.point3D_id_to_images[7].tolist() == [[3, 0], [4, 0]]
