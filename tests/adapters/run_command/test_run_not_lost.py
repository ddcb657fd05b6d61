"""`skipgs-plug run` ends no script whose work would be lost, whatever the script does to the gate or before it."""

import json
from pathlib import Path

import pytest

from skipgs_plug import cli
from skipgs_plug.core import caution

LOOP = "    loss.backward()\n"
# A condition that no share can evaluate ahead.
UNFORESEEN = LOOP + "        if iteration % int(loss.item() + 50) == 0:\n            print('seldom')\n"
# A stage of its own before the training loop.
STAGE = """
def fit(steps):
    value = torch.nn.Parameter(torch.zeros(3))
    for _ in range(steps):
        (value - 1).pow(2).sum().backward()

def training("""
# The script removes what the gate has put among the finders.
FINDERS = """        if iteration == 5:
            sys.meta_path[:] = [one for one in sys.meta_path if "skipgs" not in type(one).__module__]
"""


def edit(checkout, *pairs):
    script = Path(checkout)
    text = script.read_text()
    for old, new in pairs:
        assert old in text
        text = text.replace(old, new)
    script.write_text(text)


@pytest.fixture
def warned(monkeypatch):
    """Sentences of the warnings."""
    said = []
    monkeypatch.setattr(caution, "say", said.append)
    return said


@pytest.mark.parametrize(("steps", "code"), [(2, 2), (50, 0)])
def test_after_a_stage_of_its_own_a_script_is_not_refused(steps, code, checkout, tmp_path, capfd, warned):
    call = "        training(SimpleNamespace"
    edit(
        checkout,
        (LOOP, UNFORESEEN),
        ("def training(", STAGE.lstrip("\n")),
        (call, f"        fit({steps})\n{call}"),
    )
    assert cli.main(["run", "inria", "--cpu", "--share", "0.5", "--", checkout, str(tmp_path)]) == code
    captured, released = capfd.readouterr(), [one for one in warned if "training goes on without it" in one]
    assert len(released) == (code == 0) == captured.out.count("Training complete.")
    assert "cannot be evaluated ahead" in (released[0] if released else captured.err)


@pytest.mark.parametrize("options", [(), ("--no-gate",)])
def test_a_script_may_remove_the_finders_of_the_gate(options, checkout, tmp_path, capfd):
    edit(checkout, (LOOP, LOOP + FINDERS))
    assert cli.main(["run", "inria", "--cpu", *options, "--", checkout, str(tmp_path)]) == 0
    assert json.loads((tmp_path / "skipgs.json").read_text())["iterations"] == 60
    assert "Traceback" not in (error := capfd.readouterr().err) and "failed" not in error


def test_a_gate_that_cannot_be_detached_ends_no_run(checkout, tmp_path, monkeypatch, warned):
    def fails(gate):
        raise KeyError("of the end")

    monkeypatch.setattr("skipgs_plug.core.engine.Engine.remove", fails)
    assert cli.main(["run", "inria", "--cpu", "--", checkout, str(tmp_path)]) == 0
    assert json.loads((tmp_path / "skipgs.json").read_text())["iterations"] == 60
    assert warned == ["Detaching the gate failed (KeyError: 'of the end')."]
