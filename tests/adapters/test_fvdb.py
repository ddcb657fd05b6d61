"""fVDB's two runners: steps of an epoch, crops, and the command frgs."""

import inspect
import json
import sys
from pathlib import Path

import pytest
from lookalikes import fvdb, fvdb_frgs
from lookalikes.splats import log, new_log

from skipgs_plug import SkipGate, SkipGSError, cli


def test_batches_make_an_epoch_of_the_command_shorter():
    with SkipGate(fvdb_frgs.GaussianSplatReconstruction(batch_size=2)) as gate:
        gate.adapter.trainer.optimize(last=30)
    assert gate.config.start_iter == 4 * 3  # epochs of three batches
    assert [row["view"] for row in gate.view_table()] == ["batch"]


@pytest.mark.parametrize("make", [fvdb.SceneOptimizationRunner, fvdb_frgs.GaussianSplatReconstruction])
def test_several_crops_per_image_are_refused(make):
    runner = make()
    runner.config.crops_per_image = 4
    with pytest.raises(SkipGSError, match="each crop has a backward of its own; set it to 1"):
        SkipGate(runner)


@pytest.fixture
def frgs(tmp_path, monkeypatch):
    """Run the installed command, whose function does this with the runner's class `Runner`; its folder is current."""

    def run(adapter, body):
        files = {
            "fvdb_reality_capture/radiance_fields/gaussian_splat_reconstruction.py": inspect.getsource(fvdb_frgs),
            "fvdb_reality_capture/cli/frgs.py": "from fvdb_reality_capture.radiance_fields."
            f"gaussian_splat_reconstruction import GaussianSplatReconstruction as Runner\n\ndef frgs():\n    {body}\n",
            "fvdb_reality_capture-0.6.0.dist-info/METADATA": "Metadata-Version: 2.1\nName: fvdb_reality_capture\n",
            "fvdb_reality_capture-0.6.0.dist-info/entry_points.txt": "[console_scripts]\n"
            "frgs = fvdb_reality_capture.cli.frgs:frgs\n",
        }
        for name, text in files.items():
            (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / name).write_text(text)
        (tmp_path / "results").mkdir()
        return cli.main(["run", adapter, "--warmup", "3", "--pause-iters", "4", "--", "frgs", "reconstruct"])

    new_log()
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    yield run
    for loaded in [one for one in sys.modules if one.partition(".")[0] == "fvdb_reality_capture"]:
        del sys.modules[loaded]


@pytest.mark.parametrize("adapter", ["fvdb", "auto"])
def test_installed_command_is_gated(adapter, frgs):
    assert frgs(adapter, "Runner().optimize()") == 0
    report = json.loads(Path("results/skipgs.json").read_text())
    assert report["settings"]["adapter"] == "fvdb" and report["backwards_skipped"] > 0


def test_second_part_of_a_scene_trains_without_a_gate(frgs):
    with pytest.warns(RuntimeWarning, match="released: a second training run begins in this process"):
        assert frgs("fvdb", "Runner().optimize()\n    Runner().optimize()") == 0
    assert log.backwards[-60:] == list(range(60))
