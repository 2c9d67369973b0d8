"""Tests are found by the name of the module that they test."""

from pathlib import Path

TESTS = Path(__file__).parent
PACKAGE = TESTS.parent / "torchrg"
MAX_WITHOUT_TESTS = 9
"""Modules that only the tests of other modules reach; lower it, and never raise it."""


def test_every_module_has_a_file_of_tests():
    """The tests of ``a/b.py`` are ``a/test_b.py``, and ``a/test_b_*.py`` for a further subject."""
    modules = [path.relative_to(PACKAGE) for path in PACKAGE.rglob("*.py")]
    without = [
        str(path)
        for path in sorted(modules)
        if not path.name.startswith("__")
        and not (TESTS / path.parent / f"test_{path.stem.lstrip('_')}.py").exists()
    ]
    assert len(modules) > 150
    assert len(without) <= MAX_WITHOUT_TESTS, without
