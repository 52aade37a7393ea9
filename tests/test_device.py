"""One program for all devices: whatever a function is given on a device it answers there, never mixes devices, and says what the CPU says.

On every machine the device is a simulated one (simulated_device.py), whose values are the CPU's to the last bit; where there is CUDA, also
that, within rounding.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from references import in_patches
from simulated_device import SIMULATED, simulated_device
from sphere_scene import RADIUS, SphereScene, make_sphere

from mvps import reconstruct
from mvps.command import run
from mvps.device import chosen_device
from mvps.hull import default_cells, signed_distance
from mvps.joint.blocks import Vertices, evaluate, vertex_equations
from mvps.joint.grey import grey_lights
from mvps.joint.held_out import fit_lights
from mvps.joint.lights import light_step
from mvps.joint.neural import neural_residual
from mvps.joint.observe import ViewSamples, observe
from mvps.joint.pixels import all_pixel_normals
from mvps.joint.refine import Refined, RefineSettings, RoundSettings, refine
from mvps.joint.reflectance import Observed
from mvps.joint.steps import free_reflectance, vertex_step
from mvps.mesh import vertex_normals
from mvps.neural import moments
from mvps.occupancy import Occupancy, OccupancySettings
from mvps.photometric import normal_maps
from mvps.progress import Progress
from mvps.radiance import RadianceSettings, radiance_surface
from mvps.reconstruct import Settings
from mvps.scene import CaptureError, Law, Reconstruction
from mvps.shading import shade

CPU = torch.device("cpu")
DEVICES = ["simulated", *(["cuda"] if torch.cuda.is_available() else [])]


@pytest.fixture(params=DEVICES)
def device(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[torch.device]:
    """A device that is not the CPU."""
    # As the program does: small operations wait for each other on several threads.
    torch.set_num_threads(1)
    if request.param == "cuda":
        yield chosen_device("cuda")
    else:
        with simulated_device(monkeypatch) as made:
            yield made


@pytest.fixture(scope="module")
def scene() -> SphereScene:
    return make_sphere(4)


def tensors(value: Any) -> list[torch.Tensor]:
    """All tensors in values, in order."""
    if isinstance(value, torch.Tensor):
        return [value]
    if is_dataclass(value):
        return [t for field in fields(value) for t in tensors(getattr(value, field.name))]
    return [t for item in value for t in tensors(item)] if isinstance(value, list | tuple) else []


def same(found: Any, expected: Any, device: torch.device, within: float = 1e-3) -> None:
    """Everything found is on the device; values as expected, exactly where the device is simulated, else within a part of the largest, all
    but one in a hundred: what samples hardly determine follows their rounding."""
    assert all(t.device.type == device.type for t in tensors(found)) and len(tensors(found)) == len(tensors(expected)) > 0
    for a, b in zip(tensors(found), tensors(expected), strict=True):
        same_values(a.cpu().numpy(), b.cpu().numpy(), device, within)


def same_values(found: np.ndarray, expected: np.ndarray, device: torch.device, within: float = 1e-3) -> None:
    """The same for arrays."""
    if device == SIMULATED:
        np.testing.assert_array_equal(found, expected)
    else:
        both, either = (which(np.isfinite(found), np.isfinite(expected)) for which in (np.logical_and, np.logical_or))
        assert found.shape == expected.shape and both.sum() >= 0.99 * either.sum()
        assert np.quantile(np.abs(found[both] - expected[both]), 0.99) <= within * np.abs(expected[both]).max()


def directions(seed: int, *shape: int) -> torch.Tensor:
    """Unit vectors about the z axis."""
    aside = 0.5 * torch.randn(*shape, 3, generator=torch.Generator().manual_seed(seed))
    return torch.nn.functional.normalize(aside + torch.tensor([0.0, 0.0, 1.0]), dim=-1)


def problem(scene: SphereScene, device: torch.device) -> tuple[list[ViewSamples], Vertices, Any, Any, Any, list[torch.Tensor]]:
    """Samples, vertices that are a little off, lights, law, tie and rotations of the sphere."""
    r = scene.reconstruction
    values = np.column_stack([r.material.albedo.mean(1), r.material.specular_weight])
    normal, reflectance, mesh = (
        torch.tensor(a, dtype=torch.float32, device=device) for a in (r.material.normal, 0.9 * values, vertex_normals(r.surface))
    )
    vertices = Vertices(normal, reflectance, 0.05 * reflectance[:, 0])
    rotations = [torch.tensor(view.camera.rotation, dtype=torch.float32, device=device) for view in scene.capture.views]
    law = replace(r.material.law, grazing=0.1)
    views = observe(scene.capture, r.surface, r.lights, device)
    return views, vertices, grey_lights(r.lights, device), law, free_reflectance(mesh, 0.1, 3), rotations


def test_the_simulated_device_has_a_wall(monkeypatch: pytest.MonkeyPatch) -> None:
    with simulated_device(monkeypatch) as device:
        there = torch.arange(4.0, device=device)
        assert there.device == device and float(there.sum()) == 6 and there.cpu().tolist() == [0, 1, 2, 3]
        assert torch.tensor([1.0, 2.0], device=device).cpu().tolist() == [1, 2]
        there[there > 1] = 7.0
        assert there.nonzero()[:, 0].cpu().tolist() == [1, 2, 3]
        for mixed in (lambda: there + torch.ones(4), lambda: there[torch.tensor([0, 1])], lambda: torch.ones(1, 4) @ there):
            with pytest.raises(RuntimeError, match="wanted all tensors on one device"):
                mixed()
        with pytest.raises((TypeError, RuntimeError)):
            there.numpy()


def test_image_model(device: torch.device) -> None:
    normal, view, light = directions(0, 50), directions(1, 50), directions(2, 7)
    albedo, weight = directions(3, 50).abs(), directions(4, 50).abs()[:, :2]
    law = Law((8.0, 60.0), 0.2)
    found = shade(*(t.to(device) for t in (normal, view, light, albedo, weight)), law)
    same(found, shade(normal, view, light, albedo, weight, law), device, 1e-5)


def test_vertices_and_lights(scene: SphereScene, device: torch.device) -> None:
    results = []
    for on in (device, CPU):
        views, vertices, lights, law, tie, rotations = problem(scene, on)
        seen = views[0].vertex
        shaded = evaluate(vertices.normal[seen], vertices.reflectance[seen], views[0].towards, lights[0], law)
        equations = vertex_equations(views, vertices, lights, law)
        views, vertices, tie, patches = in_patches(scene.reconstruction.surface, views, vertices, tie)
        stepped, _ = light_step(views, vertices, lights, law, tie, patches, rotations, True)
        results.append((shaded, equations, stepped, vertex_step(views, vertices, lights, law, tie, patches=patches)))
    same(*results, device)


def test_photometric_stereo(scene: SphereScene, device: torch.device) -> None:
    found, expected = (normal_maps(scene.capture, scene.reconstruction.lights, on) for on in (device, CPU))
    compare_maps(found, expected, device)


def test_normals_of_pixels(scene: SphereScene, device: torch.device) -> None:
    r = scene.reconstruction
    found, expected = (all_pixel_normals(scene.capture, r.surface, r.material, r.lights, None, on) for on in (device, CPU))
    compare_maps(found, expected, device)


def compare_maps(found: Sequence[Any], expected: Sequence[Any], device: torch.device) -> None:
    for a, b in zip(found, expected, strict=True):
        for name in ("normal", "albedo", "confidence"):
            same_values(getattr(a, name), getattr(b, name), device)


def test_lights_of_held_out_photographs(scene: SphereScene, device: torch.device) -> None:
    r = scene.reconstruction
    found, expected = (fit_lights(scene.capture, r.surface, r.material, True, on) for on in (device, CPU))
    for a, b in zip((*found.direction, *found.intensity), (*expected.direction, *expected.intensity), strict=True):
        same_values(a, b, device)


def test_neural_residual(scene: SphereScene, device: torch.device, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mvps.joint.neural.STEPS", 100)
    gains, residuals = [], []
    for on in (device, CPU):
        views, vertices, lights, law, _, _ = problem(scene, on)
        # The half vector's tangential part changes the samples, so that there is something to learn.
        along = [moments(vertices.normal[s.vertex], s.towards, of.direction)[..., 4] for s, of in zip(views, lights, strict=True)]
        views = [replace(s, image=s.image * torch.exp(6 * square)) for s, square in zip(views, along, strict=True)]
        of = Observed(scene.capture, scene.reconstruction.surface, views, vertices, lights, law)
        trial, residual = neural_residual(of, torch.full_like(vertices.scale, 0.2), 0.1, np.random.default_rng(0))
        gains.append(trial.gain)
        residuals.append(residual)
    assert gains[0] == (gains[1] if device == SIMULATED else pytest.approx(gains[1], rel=0.2))
    found, expected = residuals
    assert found is not None and expected is not None
    same_values(found.share, expected.share, device)
    same_values(found.code, expected.code, device, 0.02)


def test_stage_one(scene: SphereScene, device: torch.device, monkeypatch: pytest.MonkeyPatch) -> None:
    # The CPU too takes a batch as a whole here: the order of a sum is part of its value.
    monkeypatch.setattr("mvps.fieldtraining.PARTS", 1)
    plan = OccupancySettings(steps=20 if device == SIMULATED else 120, rays=256, ring_rays=128)
    hull = signed_distance(scene.capture, default_cells(scene.capture))
    maps = normal_maps(scene.capture, scene.reconstruction.lights, CPU)
    surfaces, losses = [], []
    for on in (device, CPU):
        reported: list[Any] = []
        field = Occupancy(scene.capture, hull, plan, 0, on)
        surfaces.append(field.trained(maps, plan, lambda _, loss, reported=reported: reported.append(loss)))  # type: ignore[misc]
        losses.append(reported)
    # No step waits for the device.
    assert all(loss.device.type == device.type for loss in losses[0]) and len(losses[0]) == plan.steps
    if device == SIMULATED:
        np.testing.assert_array_equal(surfaces[0].vertices, surfaces[1].vertices)
        assert [float(loss) for loss in losses[0]] == [float(loss) for loss in losses[1]]
    else:
        # Other random numbers, and sums in an order of their own.
        radius = [np.median(np.linalg.norm(surface.vertices, axis=1)) for surface in surfaces]
        assert abs(radius[0] - radius[1]) < 0.01 * RADIUS


@pytest.mark.parametrize("density", [True, False], ids=["density", "occupancy"])
def test_radiance_fields(scene: SphereScene, device: torch.device, density: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mvps.fieldtraining.PARTS", 1)
    plan = RadianceSettings(steps=10 if device == SIMULATED else 120, rays=256, ring_rays=128)
    hull, given = signed_distance(scene.capture, default_cells(scene.capture)), scene.reconstruction.lights
    maps = normal_maps(scene.capture, given, CPU)
    surfaces = [radiance_surface(scene.capture, hull, given, maps, density, plan, 0, on, lambda *_: None) for on in (device, CPU)]
    if device == SIMULATED:
        np.testing.assert_array_equal(surfaces[0].vertices, surfaces[1].vertices)
    else:
        radius = [np.median(np.linalg.norm(surface.vertices, axis=1)) for surface in surfaces]
        assert abs(radius[0] - radius[1]) < 0.01 * RADIUS


def lights(of: Reconstruction | Refined) -> tuple[np.ndarray, ...]:
    return (*of.lights.direction, *of.lights.intensity)


def test_rounds_that_go_on_from_each_other(scene: SphereScene, device: torch.device) -> None:
    r, results = scene.reconstruction, []
    maps = normal_maps(scene.capture, r.lights, CPU)
    plan = RefineSettings((RoundSettings(3.0, 1.2, 0.4), RoundSettings(3.0, 1.2, 0.4, crease=0.1)))
    for on in (device, CPU):
        refined = refine(scene.capture, r.surface, r.lights, maps, Law((8.0,)), plan, 0, on, lambda *_: None)
        results.append((refined.surface.vertices, refined.material.normal, refined.material.albedo, *lights(refined)))
    for a, b in zip(*results, strict=True):
        # Meshes that differ by rounding may be split into other ones.
        same_values(*((a, b) if device == SIMULATED else (np.median(v, axis=0) for v in (a, b))), device, 0.02)


def test_reconstruction(scene: SphereScene, device: torch.device, monkeypatch: pytest.MonkeyPatch) -> None:
    """All of a draft, with a light held out."""
    results = []
    for on in (device, CPU):
        monkeypatch.setattr("mvps.device.chosen_device", lambda _, on=on: on)
        settings = Settings("sphere", "draft", hold_out_lights=(3,))
        results.append(reconstruct.reconstruct(scene.capture, settings, None, Progress()))
    found, expected = results
    if device == SIMULATED:
        arrays = [(r.surface.vertices, r.material.normal, r.material.albedo, *lights(r), *r.normal_maps) for r in results]
        for a, b in zip(*arrays, strict=True):
            np.testing.assert_array_equal(a, b)
    else:
        radius = [np.linalg.norm(r.surface.vertices, axis=1) for r in results]
        assert abs(np.median(radius[0]) - np.median(radius[1])) < 1e-3 * RADIUS
        turned = [(a * b).sum(1) for a, b in zip(found.lights.direction, expected.lights.direction, strict=True)]
        assert np.degrees(np.arccos(np.clip(np.concatenate(turned), -1, 1))).max() < 0.5


def test_cuda_without_cuda_is_refused_with_one_sentence(
    scene: SphereScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    assert chosen_device("auto") == chosen_device("cpu") == CPU
    with pytest.raises(CaptureError, match="wanted a CUDA device"):
        chosen_device("cuda")
    monkeypatch.setattr("mvps.load.read_capture", lambda *_: scene.capture)
    assert run(reconstruct.main, ["somewhere", "--out", str(tmp_path / "out"), "--device", "cuda", "--quiet"]) == 2
    said = capsys.readouterr().err
    assert said.startswith("mvps: --device: wanted a CUDA device") and said.count("\n") == 1 and not (tmp_path / "out").exists()
