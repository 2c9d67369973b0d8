"""Deprecations name their replacement and the version of their removal."""

import inspect
import warnings

from torchrg._deprecated import warn_deprecated


def test_deprecation_names_the_replacement_the_removal_and_the_calling_line():
    def old():
        warn_deprecated("old()", "new()", removal="0.3.0")

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        old()
    (warning,) = caught
    assert warning.category is DeprecationWarning
    assert str(warning.message) == (
        "old() is deprecated and will be removed in torchrg 0.3.0; use new()."
    )
    assert (warning.filename, warning.lineno) == (__file__, inspect.currentframe().f_lineno - 6)
