"""Small pictures for galleries and notebooks."""

import pytest

from torchrg.render import gallery, render_cloud


@pytest.fixture
def small_pictures(monkeypatch):
    def small(*arguments, **settings):
        return render_cloud(*arguments, **settings, width=80)

    monkeypatch.setattr(gallery, "render_cloud", small)
