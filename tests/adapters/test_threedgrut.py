"""3DGRUT: a failure of the adapter's own code in the midst of training loses no run."""

import pytest
from lookalikes import threedgrut
from lookalikes.splats import NAMES, log, new_log

from skipgs_plug import SkipGate


def test_a_view_that_has_no_name_releases_the_gate():
    new_log()
    trainer = threedgrut.Trainer3DGRUT()
    trainer.train_dataset.image_paths = NAMES[:1]
    with SkipGate(trainer) as gate:
        with pytest.warns(RuntimeWarning, match="goes on without it, .*IndexError"):
            trainer.run_training()
        assert not gate.patched
    assert log.backwards == [*range(threedgrut.FIRST, threedgrut.LAST + 1)]
