"""The neural residual: its function, when it is kept, and that photographs and files carry it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from sphere_scene import SphereScene, make_sphere

from mvps.export import read_reconstruction, write_reconstruction
from mvps.joint.blocks import Vertices, evaluate
from mvps.joint.grey import grey_lights
from mvps.joint.neural import LEAST_VERTICES, neural_residual
from mvps.joint.observe import observe
from mvps.joint.reflectance import Observed
from mvps.mesh import normalise
from mvps.neural import MOMENTS, inputs, log_factor, moments
from mvps.rendering import photograph, points_under
from mvps.scene import CaptureError, Residual
from mvps.visibility import RayCaster

CPU = torch.device("cpu")
POOR = 0.1


@pytest.fixture(scope="module")
def scene() -> SphereScene:
    return make_sphere(4)


def unit(rng: np.random.Generator, n: int) -> torch.Tensor:
    return torch.tensor(normalise(rng.normal(size=(n, 3))))


def network(rng: np.random.Generator, width: int) -> list[tuple[torch.Tensor, torch.Tensor]]:
    shapes = ((8, width), (8, 8), (1, 8))
    return [(torch.tensor(rng.normal(0, 0.5, s)), torch.tensor(rng.normal(0, 0.5, s[0]))) for s in shapes]


def test_light_and_view_may_change_places() -> None:
    rng = np.random.default_rng(0)
    n, v, light, code = unit(rng, 1), unit(rng, 1), unit(rng, 1), torch.tensor(rng.normal(size=(1, MOMENTS + 2)))
    assert torch.allclose(inputs(n, v, light, code), inputs(n, light, v, code), atol=1e-12)


def test_values_are_finite_where_directions_meet_and_oppose() -> None:
    n = torch.tensor([[0.0, 0.0, 1.0]])
    light = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    x = inputs(n, n, light, torch.ones(1, MOMENTS + 2))
    assert torch.isfinite(x).all() and torch.isfinite(moments(n, n, light)).all()


def test_derivatives_against_finite_differences() -> None:
    rng = np.random.default_rng(1)
    x = inputs(unit(rng, 5), unit(rng, 5), unit(rng, 3), torch.tensor(rng.normal(size=(5, MOMENTS + 2))))
    flat = [p.requires_grad_() for layer in network(rng, x.shape[-1]) for p in layer]
    assert torch.autograd.gradcheck(lambda *p: log_factor(x, list(zip(p[::2], p[1::2], strict=True))), flat, atol=1e-6)


def observed(scene: SphereScene, stretched: float, noise: float = 0.05) -> tuple[Observed, torch.Tensor]:
    """The sphere's true grey model, samples of it with noise (relative) and with lobes that the tangential part of the half vector along
    an axis of each place changes by `stretched`, and relative residuals."""
    # As refine does: small operations wait for each other on several threads.
    torch.set_num_threads(1)
    r = scene.reconstruction
    values = np.column_stack([r.material.albedo.mean(1), r.material.specular_weight])
    normal, reflectance = (torch.tensor(a, dtype=torch.float32) for a in (r.material.normal, values))
    vertices = Vertices(normal, reflectance, 0.2 * reflectance[:, 0])
    lights, generator = grey_lights(r.lights, CPU), torch.Generator().manual_seed(0)
    turn = torch.tensor(r.surface.vertices[:, 0] / 10, dtype=torch.float32)
    axis = torch.stack([turn.cos(), turn.sin(), 0 * turn], 1)
    views = []
    for samples, of_view in zip(observe(scene.capture, r.surface, r.lights, CPU), lights, strict=True):
        at = samples.vertex
        predicted = evaluate(normal[at], reflectance[at], samples.towards, of_view, r.material.law).predicted
        along = (moments(normal[at], samples.towards, of_view.direction)[..., 1:4] * axis[at, None]).sum(-1)
        random = torch.randn(predicted.shape, generator=generator)
        views.append(replace(samples, image=predicted * torch.exp(stretched * (along**2 - 0.05) + noise * random)))
    return Observed(scene.capture, r.surface, views, vertices, lights, r.material.law), torch.full((len(normal),), 0.2)


def test_what_lobes_cannot_express_is_learnt_and_predicted_better(scene: SphereScene) -> None:
    of, relative = observed(scene, 6.0)
    trial, residual = neural_residual(of, relative, POOR, np.random.default_rng(0))
    assert trial.kept and trial.gain > 0.3 and residual is not None
    assert (residual.share == 1).all() and np.isfinite(residual.code).all()
    again = neural_residual(of, relative, POOR, np.random.default_rng(0))[1]
    assert again is not None and np.array_equal(again.code, residual.code)
    assert all(np.array_equal(a, b) for p, q in zip(residual.layers, again.layers, strict=True) for a, b in zip(p, q, strict=True))


def test_what_fits_gets_none(scene: SphereScene) -> None:
    of, relative = observed(scene, 0.0)
    trial, residual = neural_residual(of, relative, POOR, np.random.default_rng(0))
    assert not trial.kept and residual is None
    relative[: len(relative) // 2 + 2] = 0.02
    assert (relative > POOR).sum() > LEAST_VERTICES
    trial, residual = neural_residual(of, relative, POOR, np.random.default_rng(0))
    assert not trial.kept and residual is None and trial.seconds < 0.1


def test_only_vertices_that_fit_badly_get_one(scene: SphereScene) -> None:
    of, relative = observed(scene, 6.0)
    relative[::3], relative[1::30] = 0.02, torch.nan
    residual = neural_residual(of, relative, POOR, np.random.default_rng(0))[1]
    assert residual is not None
    assert np.array_equal(residual.share == 1, (relative > POOR).numpy()) and not residual.code[::3].any()


def doubling(scene: SphereScene) -> Residual:
    """A factor of two on one half of the sphere."""
    vertices = scene.reconstruction.surface.vertices
    half, code = (vertices[:, 2] > 0).astype(np.float32), np.random.default_rng(0).normal(size=(len(vertices), MOMENTS + 3))
    layers = ((np.zeros((4, 12), np.float32), np.ones(4, np.float32)), (np.zeros((1, 4), np.float32), np.full(1, np.log(2), np.float32)))
    return Residual(half, code.astype(np.float32), layers)


def test_photographs_show_it_and_it_fades_without_a_seam(scene: SphereScene) -> None:
    r, view = scene.reconstruction, scene.capture.views[0]
    caster, material = RayCaster(r.surface), replace(r.material, residual=doubling(scene))
    lights = (r.lights.direction[0], r.lights.intensity[0])
    without, with_it = (photograph(caster, m, view.camera, view.pixels, *lights) for m in (r.material, material))
    share = points_under(caster, material, view.camera, view.pixels).share
    assert 0 < ((share > 0) & (share < 1)).mean() < 0.2
    np.testing.assert_array_equal(with_it[share == 0], without[share == 0])
    np.testing.assert_allclose(with_it, without * 2 ** share[:, None, None], rtol=1e-5)


def test_files_carry_it_and_damage_is_named(scene: SphereScene, tmp_path: Path) -> None:
    r = scene.reconstruction
    residual = doubling(scene)
    write_reconstruction(replace(r, material=replace(r.material, residual=residual)), tmp_path / "with")
    write_reconstruction(r, tmp_path / "without")
    read = read_reconstruction(tmp_path / "with").material.residual
    assert read is not None and read_reconstruction(tmp_path / "without").material.residual is None
    np.testing.assert_array_equal(read.share, residual.share)
    np.testing.assert_array_equal(read.code, residual.code)
    assert all(np.array_equal(a, b) for p, q in zip(read.layers, residual.layers, strict=True) for a, b in zip(p, q, strict=True))
    with np.load(tmp_path / "with" / "material.npz") as arrays:
        kept = {name: arrays[name] for name in arrays if name != "residual_weight_1"}
    np.savez(tmp_path / "with" / "material.npz", **kept)
    with pytest.raises(CaptureError, match="layers that end in one output"):
        read_reconstruction(tmp_path / "with")
