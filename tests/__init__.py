"""Tests of torchrg; ``tests.made`` holds scenes that scripts use too."""
