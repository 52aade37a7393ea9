"""mvps.checks.ambient: ambient light is found and taken off, photographs without stay as they are."""

from __future__ import annotations

import sys
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import trimesh

from mvps.checks import ambient as checks
from mvps.checks.ambient import ambient
from mvps.checks.radiometry import is_metal
from mvps.scene import Capture, View
from mvps.synthetic.scene import render_capture
from mvps.synthetic.settings import SceneSettings

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks"))

from hard.cases import by_chance
from hard.scenes import made_of, rendered, shaped_as, surface_of


@cache
def clean(seed: int = 0, strength: float = 1.0, noise: float = 0.002) -> Capture:
    return render_capture(SceneSettings(views=4, lights=10, size=96, seed=seed, strength=strength, noise=noise))[0]


def lit(view: View, share: float) -> View:
    """The view with its mean over the lights added to every photograph, its median a share of theirs."""
    image = view.samples.mean(1, keepdims=True)
    image *= share * np.median(view.samples) / np.median(image)
    room = 65535 / (view.samples.max() + image.max())
    return replace(view, samples=np.rint((view.samples + image) * room).astype(np.uint16))


def with_ambient(capture: Capture, share: float) -> Capture:
    return Capture(capture.name, tuple(lit(view, share) for view in capture.views))


def share_of(capture: Capture) -> float:
    return checks._share(checks._told(checks._enough(capture)))


@pytest.mark.parametrize(("seed", "strength", "noise"), [(0, 1.0, 0.002), (1, 0.0, 0.002), (2, 2.0, 0.01), (3, 1.0, 0.03)])
def test_photographs_without_stay_as_they_are(seed: int, strength: float, noise: float) -> None:
    capture = clean(seed, strength, noise)
    after, found = ambient(capture)
    assert after is capture and not found


@pytest.mark.parametrize("share", [0.05, 0.2])
def test_it_is_found_and_most_of_it_taken_off(share: float) -> None:
    given = with_ambient(clean(), share)
    after, (finding,) = ambient(given)
    assert finding.about == "radiometry" and finding.mended
    for before, harmed, mended in zip(clean().views, given.views, after.views, strict=True):
        lit_ = (before.samples > np.median(before.samples)) & mended.usable()[..., None] & harmed.usable()[..., None]
        scale = np.median(mended.samples[lit_] / before.samples[lit_])
        off, was = (np.abs(v.samples / scale - before.samples)[lit_].mean() for v in (mended, harmed))
        assert off < 0.6 * was
    assert share_of(after) < 0.3 * share_of(given)


def parts(before: Capture, after: Capture) -> np.ndarray:
    """(views,) by what part the second capture is darker."""
    return np.array([1 - b.samples.sum(dtype=float) / a.samples.sum(dtype=float) for a, b in zip(before.views, after.views, strict=True)])


@pytest.mark.parametrize(("case", "turned", "tolerance"), [(4, [3, 4, 5], 0.01), (92, [6], 0.07)])
def test_views_whose_factors_come_out_turned_are_told_by_others(case: int, turned: list[int], tolerance: float) -> None:
    """By their own half of such views would be taken off."""
    sample, _ = by_chance(case)
    views = sample.given.views
    assert [k for k, view in enumerate(views) if not checks._agreed(checks._factors(view, checks._some(view)))] == turned
    after, _ = ambient(sample.given)
    np.testing.assert_allclose(parts(sample.given, after), parts(sample.given, sample.good), atol=tolerance)


def test_a_view_that_no_factors_tell_has_as_much_as_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    given = with_ambient(clean(), 0.2)
    found = parts(given, ambient(given)[0])
    told = checks._told(given.views)
    monkeypatch.setattr(checks, "_told", lambda views: [None, *told[1:]])
    without = parts(given, ambient(given)[0])
    np.testing.assert_array_equal(without[1:], found[1:])
    assert without[0] == pytest.approx(found[0], rel=0.2)


def test_what_is_no_data_stays_so() -> None:
    given = with_ambient(clean(), 0.2).without({"view_02": [3]})
    after, _ = ambient(given)
    assert not after.views[1].shown[2] and after.views[1].shown.sum() == 9


def test_inter_reflection_is_none() -> None:
    views = []
    for view in clean().views:
        # What a lamp sends comes back from all around, a tenth of it.
        sent = 0.1 * np.median(view.samples, axis=0, keepdims=True) + 0.9 * view.samples
        views.append(replace(view, samples=np.rint(sent).astype(np.uint16)))
    assert share_of(Capture("lit", tuple(views))) == 0


@pytest.mark.parametrize(("sides", "weight", "sharpness"), [(6, (1.0,), (8.0,)), (6, (0.6, 0.6), (5.0, 30.0)), (5, (1.0,), (8.0,))])
def test_tails_of_lobes_on_flat_sides_are_none(sides: int, weight: tuple[float, ...], sharpness: tuple[float, ...]) -> None:
    settings = SceneSettings(views=8, lights=10, size=96)
    prism = surface_of(trimesh.creation.cylinder(0.6, 0.8, sections=sides))
    capture = rendered(settings, lambda _: made_of(shaped_as(prism, settings), 0.0, weight, sharpness))[0]
    # Three factors, which say nothing of metals, fit as many normals as these.
    assert not is_metal(capture)
    after, found = ambient(capture)
    assert after is capture and not found


def test_few_lights_say_nothing() -> None:
    few = clean().select({view.name: view.lights[:4] for view in clean().views})
    assert ambient(with_ambient(few, 0.2))[1] == []
