"""Light on surfaces whose shape is known."""

import pytest
import torch

from torchrg.render.raster import light_colors, shade_hollows

FOCAL = 200.0


def inverse_depth_of(planes, size=60):
    """Inverse depth of the nearest of some planes ``n . X = d`` at each pixel."""
    line = (torch.arange(size) - size / 2) / FOCAL
    rows, columns = torch.meshgrid(line, line, indexing="ij")
    rays = torch.stack([columns, rows, torch.ones_like(rows)], dim=-1).double()
    inverse = [rays @ torch.tensor(normal).double() / offset for normal, offset in planes]
    return torch.stack(inverse).amax(dim=0).float()


@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (0.5, 0.3, 0.8), (0.98, 0.0, 0.2)])
def test_planes_are_bright_however_they_are_tilted(normal):
    brightness = shade_hollows(inverse_depth_of([(normal, 2.0)]), focal=FOCAL, radius=2.0)
    assert float(brightness[8:-8, 8:-8].amin()) > 0.999


def test_what_lies_behind_an_edge_is_dark_and_the_edge_is_not():
    inverse = torch.full((40, 40), 0.5)
    inverse[:, 20:] = 1.0
    brightness = shade_hollows(inverse, focal=FOCAL, radius=2.0)[20]
    assert float(brightness[19]) < 0.8
    assert float(brightness[20:].amin()) == 1
    assert float(brightness[:10].amin()) == 1


def test_creases_are_dark_and_ridges_are_not():
    corner = [((0.7, 0.0, 0.7), 2.0), ((-0.7, 0.0, 0.7), 2.0)]
    hollow = 1 / inverse_depth_of(corner).clamp(min=1e-6)
    far_side = torch.minimum(inverse_depth_of(corner[:1]), inverse_depth_of(corner[1:]))
    ridge = shade_hollows(far_side, focal=FOCAL, radius=2.0)
    crease = shade_hollows(1 / hollow, focal=FOCAL, radius=2.0)
    assert float(crease[30, 30]) < 0.93
    assert float(ridge[30, 30]) == 1


def test_nothing_is_bright_and_casts_nothing():
    inverse = torch.zeros(30, 30)
    inverse[10:20, 10:20] = 1.0
    assert bool((shade_hollows(inverse, focal=FOCAL, radius=1.0) == 1).all())


@pytest.mark.parametrize("scale", [1e-4, 1e3])
def test_shade_does_not_depend_on_the_unit(rng, scale):
    inverse = 0.5 + torch.rand(30, 30, generator=rng)
    one = shade_hollows(inverse, focal=FOCAL, radius=2.0)
    other = shade_hollows(inverse / scale, focal=FOCAL, radius=2.0)
    torch.testing.assert_close(one, other)


def test_light_does_not_depend_on_the_sign_of_normals(rng):
    normals = torch.nn.functional.normalize(torch.randn(100, 3, generator=rng), dim=1)
    positions = torch.rand(100, 3, generator=rng) + torch.tensor([0.0, 0.0, 2.0])
    colors = torch.randint(0, 256, (100, 3), generator=rng, dtype=torch.uint8)
    assert torch.equal(
        light_colors(colors, normals, positions), light_colors(colors, -normals, positions)
    )


def test_surfaces_that_face_up_are_brighter_than_those_that_face_down():
    position = torch.tensor([[0.0, 0.0, 5.0]])
    colors = torch.full((1, 3), 200, dtype=torch.uint8)
    up, down = (torch.tensor([[0.0, y, -0.7]]) for y in (-0.7, 0.7))
    assert light_colors(colors, up, position)[0, 0] > light_colors(colors, down, position)[0, 0]
