"""Optional packages that are missing."""

import pytest

from torchrg._optional import require
from torchrg.errors import MissingDependencyError, TorchrgError


def test_missing_package_names_the_extra():
    with pytest.raises(MissingDependencyError, match=r"pip install 'torchrg\[las\]'") as info:
        require("no_such_package", extra="las", purpose="read LAS files")
    assert isinstance(info.value, TorchrgError)
    assert isinstance(info.value, ImportError)


def test_require_by_example():
    assert require("math", extra="las", purpose="read LAS files").pi > 3
