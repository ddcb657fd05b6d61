"""Sentences about scripts that need more than the CPU stand-ins have."""

from pathlib import Path

from skipgs_plug.scripts.stand_in_hints import stand_in_hint


def test_a_function_of_gsplat_without_a_stand_in_is_named(tmp_path):
    """Its first call compiles the CUDA extension, which fails in many ways without a toolkit."""
    package, here = tmp_path / "gsplat" / "gsplat", {}

    def define(path: Path, code: str) -> None:
        exec(compile(code, str(path), "exec"), here)

    define(package / "cuda" / "_wrapper.py", "def project():\n    raise ImportError('gsplat_cuda.so: cannot open')\n")
    define(package / "rendering.py", "def rasterization_2dgs():\n    project()\n")
    define(package.parent / "examples" / "simple_trainer_2dgs.py", "def main():\n    rasterization_2dgs()\n")
    define(package / "distributed.py", "def cli(function):\n    function()\n")
    try:
        here["cli"](here["main"])
    except ImportError as error:
        hint = stand_in_hint(error)
    assert hint is not None and hint.startswith("The script calls gsplat.rendering.rasterization_2dgs(), for which")
