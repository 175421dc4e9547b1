"""Values that configurations refuse."""

from types import SimpleNamespace

import numpy as np
import pytest

from gsjax.methods.settings import expect


@pytest.mark.parametrize("value", ["many", None, True, (1, 2)])
def test_anything_but_a_number_is_refused(value):
    with pytest.raises(ValueError, match=r"rates.means: expected a number, found "):
        expect(SimpleNamespace(means=value), "rates.", means=(0, np.inf))
    expect(SimpleNamespace(means=np.float32(3)), means=(0, 4))
