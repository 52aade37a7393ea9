"""The image model: laws of the shading formula."""

import pytest
import torch

from mvps.scene import Law
from mvps.shading import STEEPEST, gain, half_dot_normal, half_length, lobe, lobes, shade

N = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)


def unit(*values: float) -> torch.Tensor:
    return torch.nn.functional.normalize(torch.tensor([values], dtype=torch.float64), dim=1)


def shaded(view: torch.Tensor, light: torch.Tensor, weight: float = 0.5, sharpness: float = 30.0, grazing: float = 0.0) -> torch.Tensor:
    albedo = torch.tensor([[0.2, 0.3, 0.4]], dtype=torch.float64)
    return shade(N, view, light, albedo, torch.tensor([[weight]], dtype=torch.float64), Law((sharpness,), grazing))[0, 0]


def test_attached_shadow_is_black() -> None:
    assert (shaded(unit(0, 0, 1), unit(1, 0, -0.01)) == 0).all()


def test_lobe_peaks_at_its_gained_weight_where_the_half_vector_is_the_normal() -> None:
    view, light = unit(0.5, 0, 1), unit(-0.5, 0, 1)
    # Light and view part by twice the angle whose cosine is that of either to the normal.
    expected = (torch.tensor([0.2, 0.3, 0.4], dtype=torch.float64) + 0.5 / light[0, 2] ** 2) * light[0, 2]
    assert torch.allclose(shaded(view, light), expected)
    assert (shaded(view, unit(-0.4, 0, 1)) / unit(-0.4, 0, 1)[0, 2] < expected / light[0, 2]).all()


def test_gain_is_one_with_light_at_the_camera_and_bounded_when_they_part() -> None:
    assert gain(half_length(torch.tensor(1.0))) == 1
    assert gain(half_length(torch.tensor([-0.5, -0.9, -1.0]))).tolist() == pytest.approx([STEEPEST] * 3)


def test_reflectance_is_reciprocal() -> None:
    a, b = unit(0.3, 0.4, 1), unit(-0.7, 0.1, 0.6)
    for grazing in (0.0, -0.4):
        assert torch.allclose(shaded(a, b, grazing=grazing) / b[0, 2], shaded(b, a, grazing=grazing) / a[0, 2])


def test_grazing_changes_the_diffuse_part_alone_and_only_at_grazing_angles() -> None:
    facing, aslant = unit(0, 0, 1), unit(1, 0, 0.1)
    assert torch.allclose(shaded(facing, facing, grazing=-0.4), shaded(facing, facing))
    change = shaded(facing, aslant, grazing=-0.4) - shaded(facing, aslant)
    assert torch.allclose(change, -0.4 * (1 - aslant[0, 2]) ** 3 * torch.tensor([0.2, 0.3, 0.4], dtype=torch.float64) * aslant[0, 2])


def test_opposite_view_and_light_stay_finite() -> None:
    assert torch.isfinite(shaded(unit(1, 0, 0.001), unit(-1, 0, -0.001))).all()


def test_rounding_near_opposite_view_and_light_makes_no_highlight() -> None:
    g = torch.Generator().manual_seed(0)
    view = torch.nn.functional.normalize(torch.randn(2000, 3, generator=g), dim=1)
    light = torch.nn.functional.normalize(-view + 1e-3 * torch.randn(2000, 3, generator=g), dim=1)
    normal = torch.nn.functional.normalize(view + light, dim=1)
    values = shade(normal, view, light[:, None], torch.ones(2000, 3), torch.ones(2000, 1), Law((256.0,)))
    assert values.max() <= 2


def test_half_vector_against_its_definition() -> None:
    view, light = unit(0.2, -0.5, 1), unit(-0.6, 0.3, 0.8)
    half = torch.nn.functional.normalize(view + light, dim=1)
    assert torch.allclose(half_dot_normal((N * view).sum(-1, keepdim=True), N @ light.T, view @ light.T), N @ half.T)
    assert torch.equal(lobes(torch.ones(3), Law((5.0, 50.0))), torch.ones(3, 2))


def test_microfacets_have_the_peak_and_slope_of_a_gaussian_and_longer_tails() -> None:
    half = torch.tensor([1.0, 0.98, 0.8], dtype=torch.float64)
    (gaussian, _), (ggx, steepness) = (lobe(half, 40.0, microfacet) for microfacet in (False, True))
    assert ggx[0] == 1 and steepness[0] == 40 and (ggx[1:] > gaussian[1:]).all()
    alpha = (4 / 44) ** 0.5
    assert torch.allclose(ggx, alpha**4 / (half**2 * (alpha**2 - 1) + 1) ** 2)


def test_gradients_against_finite_differences() -> None:
    generator = torch.Generator().manual_seed(0)
    normal, view, light = (torch.randn(2, 3, dtype=torch.float64, generator=generator) for _ in range(3))
    inputs = [normal + 3 * N, view + 3 * N, light + 3 * N, torch.rand(2, 3, dtype=torch.float64), torch.rand(2, 2, dtype=torch.float64)]
    inputs = [x.requires_grad_() for x in inputs]

    def image(n: torch.Tensor, v: torch.Tensor, light: torch.Tensor, a: torch.Tensor, w: torch.Tensor) -> torch.Tensor:
        n, v, light = (torch.nn.functional.normalize(x, dim=1) for x in (n, v, light))
        return shade(n, v, light, a, w, Law((3.0, 8.0), -0.3))

    assert torch.autograd.gradcheck(image, inputs)
