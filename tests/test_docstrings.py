"""Examples in docstrings run and print what they say; the objects that a user meets first have one."""

from __future__ import annotations

import doctest
import importlib

import pytest

from skipgs_plug.adapters import registry

# Modules with examples, and the objects in them that must have one.
DOCUMENTED = {
    "skipgs_plug.gate": ("SkipGate", "SkipGate.iterations", "SkipGate.backward"),
    "skipgs_plug.core.config": ("SkipConfig",),
    "skipgs_plug.core.decision": ("Decision",),
    "skipgs_plug.core.policy": ("SkipPolicy",),
    "skipgs_plug.trainer.config": ("TrainConfig",),
    "skipgs_plug.trainer.loaders": ("load_scene",),
    "skipgs_plug.trainer.loaders.packed": ("save_packed",),
    "skipgs_plug.trainer.loop": ("Trainer",),
    "skipgs_plug.trainer.scene": ("Scene",),
    "skipgs_plug.trainer.synthetic": ("make_scene",),
    "skipgs_plug.adapters.registry": ("register_adapter",),
    "skipgs_plug.compat.settings": ("settings_class",),
    "skipgs_plug.fallback_raster.install": ("install_as_gsplat",),
    "skipgs_plug.fallback_raster.rasterize": ("rasterization",),
    "skipgs_plug.fallback_raster.runtime.threads": ("set_num_threads",),
    "skipgs_plug.fallback_raster.training.loss": ("l1_ssim_loss",),
    "skipgs_plug.fallback_raster.training.optimizer": ("Adam",),
}


@pytest.mark.parametrize("module", DOCUMENTED)
def test_examples_print_what_they_say(module: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry, "_registered", {})  # undoes the registration of an example's adapter
    loaded = importlib.import_module(module)
    runner = doctest.DocTestRunner(verbose=False)
    with_examples = set()
    for test in doctest.DocTestFinder(exclude_empty=True).find(loaded, module):
        if test.examples:
            with_examples.add(test.name.removeprefix(f"{module}."))
            report: list[str] = []
            runner.run(test, out=report.append)
            assert runner.failures == 0, "".join(report)
    assert set(DOCUMENTED[module]) <= with_examples
