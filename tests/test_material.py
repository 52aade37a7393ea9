"""The choice of the reflectance model: what helps stays, what does not goes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from references import in_patches
from sphere_scene import SphereScene, make_sphere

from mvps.joint.blocks import Vertices
from mvps.joint.grey import grey_lights
from mvps.joint.observe import observe
from mvps.joint.steps import free_reflectance
from mvps.joint.trial import held_out_errors
from mvps.material import SHARPENED, Model, choose, judged, presumed
from mvps.scene import Law

CPU = torch.device("cpu")


def errors(level: float) -> np.ndarray:
    """Errors with long tails, alike from call to call but for their level and a little noise."""
    tails = np.random.default_rng(0).lognormal(0, 1.5, 500)
    return level * tails * np.random.default_rng(int(1e6 * level)).lognormal(0, 0.1, 500)


def test_a_component_that_helps_stays_and_one_that_does_not_goes() -> None:
    def held_out(model: Model) -> np.ndarray:
        return errors(1.0 - 0.2 * (30.0 in model.sharpness) + 0.03 * model.bounce)

    model, trials = choose(Model((8.0, 30.0), True, True), held_out)
    assert model == Model((30.0,))
    assert [trial.kept for trial in trials] == [False, True, False, False, False]
    assert trials[1].gain == pytest.approx(-np.log(0.8), abs=0.02) and trials[1].noise < 0.02


def test_one_kind_of_samples_must_gain_and_none_lose() -> None:
    rng = np.random.default_rng(0)
    before, scatter = np.ones((2, 400)), np.exp(rng.normal(0, 0.3, (2, 400)))
    for factors, kept in (((0.8, 1.0), True), ((1.0, 0.8), True), ((1.0, 1.0), False), ((0.5, 1.2), False), ((1.2, 0.5), False)):
        assert judged("", before, np.array(factors)[:, None] * scatter).kept == kept
    # Few samples of great scatter do not hide what the others tell.
    unsure = np.where(np.arange(400) < 30, np.exp(rng.normal(0, 2.0, 400)), np.nan)
    assert judged("", before, np.stack([0.9 * scatter[0], unsure])).kept


def test_inter_reflection_stays_unless_shadows_speak_against_it() -> None:
    """By three standard errors; samples in the light only where there are none in shadow. Other components need proof."""
    scatter = np.random.default_rng(0).normal(size=400)
    scatter = (scatter - scatter.mean()) / scatter.std()
    nowhere = np.full(400, np.nan)

    def kept(lit: float | None, dark: float | None) -> Model:
        def held_out(model: Model) -> np.ndarray:
            added = (8.0 in model.sharpness) + model.grazing + model.bounce
            return np.stack([nowhere if sure is None else np.exp((0.1 * scatter - sure * 0.1 / 20) * added) for sure in (lit, dark)])

        return choose(Model((8.0,), True, True), held_out, sharpen=False)[0]

    with_it, without = Model((), False, True), Model()
    assert kept(2, 2) == kept(-2, -2) == kept(-9, -2) == kept(-2, None) == with_it
    assert kept(2, -4) == kept(-4, None) == kept(None, None) == without


@pytest.mark.parametrize("factor", [0.01, 100.0])
def test_one_vertex_alone_proves_nothing(factor: float) -> None:
    before, after = np.ones(50), np.full(50, np.nan)
    after[7] = factor
    assert not judged("", before, after).kept and presumed("", before, after).kept
    others = np.exp(np.random.default_rng(0).normal(-0.5, 0.3, 50))
    assert judged("", np.ones((2, 50)), np.stack([others, after])).kept


def test_vertices_without_held_out_samples_do_not_count() -> None:
    def held_out(model: Model) -> np.ndarray:
        values = errors(1.0 - 0.2 * model.grazing)
        values[::2] = np.nan
        return values

    assert choose(Model((), True, True), held_out)[0] == Model((), True, False)
    assert choose(Model((), True, True), lambda _: np.full(3, np.nan))[0] == Model()


@pytest.mark.parametrize(("best", "found"), [(12.0, 12.0), (100.0, 8 * SHARPENED)])
def test_sharpness_is_solved_within_its_bounds(best: float, found: float) -> None:
    def held_out(model: Model) -> np.ndarray:
        return errors(1.0 + float(np.log(model.sharpness[0] / best) ** 2) if model.sharpness else 9.0)

    model, trials = choose(Model((8.0,)), held_out)
    assert model.sharpness[0] == pytest.approx(found, rel=0.15) and [trial.kept for trial in trials] == [True, True]


@pytest.fixture(scope="module")
def scene() -> SphereScene:
    return make_sphere(subdivisions=4)


@pytest.mark.parametrize("glossy", [True, False])
def test_lobes_are_kept_on_a_glossy_ball_alone(scene: SphereScene, glossy: bool) -> None:
    r = scene.reconstruction
    views = observe(scene.capture, r.surface, r.lights, CPU)
    lights = grey_lights(r.lights, CPU)
    normal = torch.tensor(r.material.normal, dtype=torch.float32)
    albedo = torch.tensor(r.material.albedo.mean(1, keepdims=True), dtype=torch.float32)
    if not glossy:
        # The same ball in Lambert's paint, with one per cent of noise.
        noise = torch.Generator().manual_seed(0)
        for k, (samples, of_view) in enumerate(zip(views, lights, strict=True)):
            image = albedo[samples.vertex] * (normal[samples.vertex] @ of_view.direction.T).clamp_min(0) * of_view.intensity
            views[k] = replace(samples, image=image * (1 + 0.01 * torch.randn(image.shape, generator=noise)))
    start = Vertices(normal, albedo, albedo[:, 0].clone())
    tie = free_reflectance(normal, 0.05, 1)
    rotations = [torch.tensor(view.camera.rotation, dtype=torch.float32) for view in scene.capture.views]
    views, start, tie, patches = in_patches(r.surface, views, start, tie)
    model, _ = choose(Model((12.0, 60.0)), lambda m: held_out_errors(views, start, lights, tie, patches, rotations, Law(()), 0.0, m)[0])
    assert (len(model.sharpness) > 0) == glossy
