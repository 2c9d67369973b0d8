"""What the tests of robust estimators share."""

import pytest

from tests.robust.oracle_cases import ESTIMATORS


@pytest.fixture(params=ESTIMATORS)
def estimator(request):
    return ESTIMATORS[request.param]
