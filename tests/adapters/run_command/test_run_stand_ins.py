"""`skipgs-plug run --cpu`: errors of the stand-ins for CUDA modules, and errors of the script's own."""

import importlib.util
from pathlib import Path

import pytest

from skipgs_plug import cli


@pytest.fixture
def error_of(checkout, tmp_path, capfd):
    """Change the source of the look-alike's renderer, run its script with --cpu, and return what stderr gets."""

    def run(change):
        renderer = Path(checkout).parent / "gaussian_renderer" / "__init__.py"
        renderer.write_text(change(renderer.read_text()))
        assert cli.main(["run", "inria", "--cpu", "--", checkout, str(tmp_path)]) == 1
        return capfd.readouterr().err

    return run


def test_missing_extension_is_the_scripts_own_error(checkout, tmp_path, capfd):
    assert cli.main(["run", "inria", "--", checkout, str(tmp_path)]) == 1  # without --cpu there are no stand-ins
    error = capfd.readouterr().err
    assert "Traceback" in error and "gaussian_renderer/__init__.py" in error and "launch.py" not in error
    assert "diff_gaussian_rasterization is a CUDA extension of the trainer" in error
    assert "skipgs_plug[full]" not in error


@pytest.mark.parametrize(
    ("old", "new", "found"),
    [
        ("sh_degree=0,", "sh_degree=0, kernel_size=0.1,", "unexpected keyword argument 'kernel_size'"),
        ("means2D=points,", "means2D=points, means2D_densify=points,", "unexpected keyword argument 'means2D_densify'"),
        ("image, radii =", "image, radii, depth =", "not enough values to unpack (expected 3, got 2)"),
        (
            "import GaussianRasterizationSettings,",
            "import S, GaussianRasterizationSettings,",
            "import name 'S'",
        ),
        ("import torch\n", "import torch, diff_gaussian_rasterization._C\n", "No module named"),
        ("import torch\n", "import torch, diff_gaussian_rasterization as d; d._C.x\n", "no attribute '_C'"),
        (
            "import torch\n",
            "import torch, simple_knn._C as k; k.distCUDA2(torch.ones(9, 3), 4)\n",
            "takes 1 positional",
        ),
        ("import torch\n", "import torch, fused_ssim as f; f.fused_ssim(1, 2, window=3)\n", "argument 'window'"),
        ("return {", "settings.kernel_size; return {", "no attribute 'kernel_size'"),
        ("return {", "GaussianRasterizer(settings).integrate(model.xyz); return {", "no attribute 'integrate'"),
        ("return {", "GaussianRasterizer(settings).markVisible(); return {", "markVisible() missing 1 required"),
        (
            "image, radii = GaussianRasterizer(settings)(",
            "image, radii = (lambda *args, **kwargs: (out := GaussianRasterizer(settings)(*args, **kwargs), out[2]))(",
            "no output 2: the rasterizer has 2 outputs",
        ),
    ],
)
def test_a_feature_that_the_stand_ins_lack_is_one_sentence(error_of, old, new, found):
    error = error_of(lambda text: text.replace(old, new))
    assert "The script uses a feature that the stand-ins of --cpu lack (" in error and found in error
    assert "it needs CUDA; run it without --cpu." in error and "Traceback" not in error


@pytest.mark.skipif(importlib.util.find_spec("torchvision") is not None, reason="torchvision is installed")
@pytest.mark.parametrize(
    "line",
    [
        "from torchvision.transforms import GaussianBlur",
        "from torchvision.models import resnet18",
        "import torchvision; torchvision.utils.make_grid",
        "import torchvision.datasets",
        "from lpips.pretrained_networks import alexnet",
    ],
)
def test_a_part_of_torchvision_that_is_not_served_is_one_sentence(error_of, line):
    error = error_of(lambda text: f"{line}\n{text}")
    assert "it needs torchvision; install the version" in error and "Traceback" not in error and "CUDA" not in error


def test_a_script_that_compiles_an_extension_is_one_sentence(error_of):
    """As after `torch.utils.cpp_extension.load`, which RAIN-GS calls, where there is no CUDA compiler."""
    error = error_of(lambda text: f"raise OSError('CUDA_HOME environment variable is not set.')\n{text}")
    assert "The script compiles a CUDA extension of its own" in error and "Traceback" not in error


def test_an_option_that_a_stand_in_refuses_is_one_sentence(error_of):
    error = error_of(lambda text: text.replace("scales=", "cov3D_precomp=torch.ones(12, 6), scales="))
    assert "skipgs-plug: The CPU stand-in needs scales and rotations" in error and "Traceback" not in error


def test_a_tensor_of_another_shape_is_one_sentence(error_of):
    """As after `distCUDA2(points)[0]`: the extension of FSGS returns a pair, and the stand-in one tensor."""
    error = error_of(lambda text: text.replace("torch.full((len(model.xyz), 3), 0.2)", "torch.full((1, 3), 0.2)"))
    assert "a tensor of another shape than they take (scales must have shape" in error and "Traceback" not in error


@pytest.mark.parametrize("line", ["(1, 2)[2]", "len(1, 2)", "None.integrate", "import simple_knx"])
def test_an_error_of_the_scripts_own_keeps_its_traceback(error_of, line):
    error = error_of(lambda text: f"{line}\n{text}")
    assert "Traceback" in error and "stand-ins of --cpu" not in error


def test_a_traceback_shows_the_scripts_functions_and_not_what_the_gate_wraps_around_them(error_of):
    error = error_of(lambda text: text.replace("return {", "raise KeyError('inv_covar'); return {"))
    assert "in training" in error and "in render" in error and "KeyError: 'inv_covar'" in error
    assert "skipgs_plug/" not in error


def test_no_advice_to_give_an_option_that_is_given(error_of):
    error = error_of(lambda text: f"import diff_plane_rasterization\n{text}")
    assert "diff_plane_rasterization is a CUDA extension for which this adapter has no CPU stand-in" in error
    assert "with --cpu before" not in error
