from collections.abc import Iterator

import pytest

from skipgs_plug.core.pace.rates import ScaledRates


@pytest.fixture
def rates() -> Iterator[ScaledRates]:
    scaled = ScaledRates()
    yield scaled
    scaled.remove()
