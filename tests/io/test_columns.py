"""Integer types of columns."""

import numpy as np
import pytest

from torchrg.io.columns import narrow_integers


@pytest.mark.parametrize(
    ("low", "high", "code"),
    [
        (-(2**31), 2**31 - 1, "i4"),
        (0, 2**31, "u4"),
        (-1, 2**31, "i8"),
        (-(2**31) - 1, 0, "i8"),
        (0, 2**32, "i8"),
    ],
)
def test_integers_are_narrowed_only_where_all_fit(low, high, code):
    values = np.array([low, 0, high])
    found = narrow_integers(values, ("i4", "u4"))
    assert found.dtype == code
    assert found.tolist() == values.tolist()
