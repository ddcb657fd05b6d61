"""benchmarks/gpu/whole_run.py stores its measurements; these tests need no GPU."""

import json

import pytest

from benchmarks.gpu import whole_run

TRAINED = {"wall_seconds": 80.0, "train_seconds": 57.0, "gaussians": 1000, "peak_bytes": 2**30, "report": None}
PICTURES = {"psnr": 30.5, "ssim": 0.9, "lpips_alex": 0.08, "views": 37}


@pytest.fixture
def gpu(monkeypatch):
    """Pretend that a GPU is there, that scripts ran, and that their pictures can be measured."""
    monkeypatch.setattr(whole_run.torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(whole_run.torch.cuda, "get_device_name", lambda: "a card")
    monkeypatch.setattr(
        whole_run, "run", lambda name, mode, folder, asked, seconds: {"script": name, "mode": mode, **TRAINED}
    )
    monkeypatch.setattr(whole_run, "find_pictures", lambda folder: folder)
    monkeypatch.setattr(whole_run, "measure_pictures", lambda folder, net, device: dict(PICTURES))


def test_all_scripts_run_in_both_modes(gpu, tmp_path, capsys):
    out = tmp_path / "whole.json"
    assert whole_run.main(["scene", "checkouts", "--lpips", "alex", "--out", str(out)]) == 0
    stored = json.loads(out.read_text())["runs"]
    pairs = [(one["script"], one["mode"], one["psnr"]) for one in stored]
    assert pairs == [(name, mode, 30.5) for name in whole_run.SCRIPTS for mode in ("auto", "own")]
    assert (
        "| gsplat | auto | 80.0 | 57.0 | 30,000 | 1,000 | 1.00 | 30.50 | 0.9000 | 0.0800 |" in capsys.readouterr().out
    )


def test_a_run_is_stored_before_its_pictures_are_measured(gpu, monkeypatch, tmp_path):
    def interrupted(folder, net, device):
        raise KeyboardInterrupt

    monkeypatch.setattr(whole_run, "measure_pictures", interrupted)
    with pytest.raises(KeyboardInterrupt):
        whole_run.main(["scene", "checkouts", "--only", "fastgs", "--out", str(tmp_path / "whole.json")])
    (stored,) = json.loads((tmp_path / "whole.json").read_text())["runs"]
    assert stored["train_seconds"] == 57.0 and "psnr" not in stored


def test_a_failed_run_is_stored_and_the_next_one_goes_on(gpu, monkeypatch, tmp_path, capsys):
    def run(name, mode, folder, asked, seconds):
        return {"script": name, "mode": mode, "wall_seconds": 3.0, "error": "out of memory"}

    monkeypatch.setattr(whole_run, "run", run)
    assert whole_run.main(["scene", "checkouts", "--only", "gsplat", "--out", str(tmp_path / "whole.json")]) == 1
    assert [one["error"] for one in json.loads((tmp_path / "whole.json").read_text())["runs"]] == ["out of memory"] * 2
    assert "| gsplat | own | 3.0 | out of memory |" in capsys.readouterr().out
