"""PGSR renders a second view with gradients: the gate decides on the first."""

from cases import RULE, run, script
from lookalikes import pgsr
from lookalikes.splats import make_cameras, pick


def test_view_of_an_iteration_is_the_one_that_is_rendered_first():
    _, gate = run(script("pgsr", pgsr), **RULE)
    cameras = make_cameras()
    assert [row.view for row in gate.trace] == [pick(cameras, row.step).image_name for row in gate.trace]
    assert len(gate.trace) == pgsr.LAST + 1 - pgsr.START
