"""What the tests of commands share."""

import pytest


@pytest.fixture(scope="module")
def room_file(folder_of_clouds):
    return folder_of_clouds("room.npz", num_points=6000) / "room.npz"
