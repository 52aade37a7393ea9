"""mvps.checks.exponent and mvps.curves: a curve that few lights or noise hide is suspected, tried out and undone; what is none stays."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import mvps.curves
import mvps.sound
from mvps.checks.exponent import looks_curved
from mvps.checks.radiometry import BETTER, left_in
from mvps.curves import contrast, exponent_left_in
from mvps.progress import Progress
from mvps.scene import Capture, CaptureError, Float, View
from mvps.sound import sound
from mvps.synthetic.scene import render_capture
from mvps.synthetic.settings import SceneSettings


@cache
def made(lights: int, noise: float) -> Capture:
    return render_capture(SceneSettings(views=6, lights=lights, size=96, noise=noise))[0]


def bent(capture: Capture, exponent: float) -> Capture:
    """The capture with codes radiance^(1 / exponent)."""

    def of_view(view: View) -> View:
        codes = np.rint(65535 * view.radiance() ** (1 / exponent)).astype(np.uint16)
        return replace(view, samples=codes, scale=1 / 65535, saturation=65535)

    return Capture(capture.name, tuple(of_view(view) for view in capture.views))


@pytest.mark.parametrize(("lights", "noise"), [(6, 0.003), (10, 0.03)], ids=["few lights", "noise"])
def test_a_curve_that_photographs_alone_do_not_prove_is_undone(lights: int, noise: float) -> None:
    recorded = bent(made(lights, noise), 2.0)
    assert left_in(recorded) is None, "three factors alone would do"
    after, found = sound(recorded, Progress())
    assert [one.mended for one in found if one.about == "radiometry"] == [True]
    before, undone = recorded.views[0].radiance(), after.views[0].radiance()
    middling = (before > 0.2) & (before < 0.9)
    # Lights turn by some 7 degrees for an exponent that is off by one.
    assert np.median(np.log(undone[middling]) / np.log(before[middling])) == pytest.approx(2.0, abs=0.25)


@pytest.mark.parametrize(("lights", "noise"), [(6, 0.003), (10, 0.03), (10, 0.1)])
def test_linear_photographs_do_not_look_curved(lights: int, noise: float) -> None:
    assert not looks_curved(made(lights, noise))


@pytest.mark.parametrize("lights", [4, 1])
def test_fewer_lights_than_five_say_nothing(lights: int) -> None:
    capture = bent(made(6, 0.003), 2.0)
    assert looks_curved(capture)
    assert not looks_curved(capture.select({view.name: view.lights[:lights] for view in capture.views}))


def test_linear_photographs_that_look_curved_stay_as_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    capture, asked = made(6, 0.003), []
    honest = mvps.curves.misfit

    def counted(of: Capture, exponent: float) -> float:
        asked.append(exponent)
        return honest(of, exponent)

    monkeypatch.setattr(mvps.sound, "looks_curved", lambda _: True)
    monkeypatch.setattr(mvps.curves, "misfit", counted)
    after, found = sound(capture, Progress())
    assert asked == [1.0, 1.4]
    assert after is capture and not found


def test_of_a_metal_nothing_is_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mvps.sound, "looks_curved", lambda _: True)
    monkeypatch.setattr(mvps.sound, "is_metal", lambda _: True)
    monkeypatch.setattr(mvps.curves, "misfit", lambda *_: pytest.fail("tried"))
    assert sound(made(6, 0.003), Progress()) == (made(6, 0.003), [])


@pytest.mark.parametrize(
    ("misfit", "tried", "told"),
    [
        (lambda e: 2 * (e - 1.7) ** 2, (1.0, 1.4, 1.8, 2.2), 1.7),
        (lambda e: 2 * (e - 1.3) ** 2, (1.0, 1.4, 1.8), None),
        (lambda e: e, (1.0, 1.4), None),
        (lambda e: -e, (1.0, 1.4, 1.8, 2.2, 2.6), None),
    ],
    ids=["between steps", "a gain too small", "none", "beyond all"],
)
def test_exponents_are_tried_until_they_get_worse(monkeypatch: pytest.MonkeyPatch, misfit, tried, told) -> None:  # type: ignore[no-untyped-def]
    asked: list[float] = []
    monkeypatch.setattr(mvps.curves, "misfit", lambda _, exponent: misfit(exponent))

    def under(exponent: float) -> Capture:
        asked.append(exponent)
        return made(6, 0.003)

    found = exponent_left_in(under)
    assert tuple(asked) == tried
    if told is None:
        assert found is None
    else:
        assert found is not None and found[0] == pytest.approx(told) and found[1] > BETTER


@pytest.mark.parametrize("fails", [1.0, 1.4, 2.2])
def test_where_something_cannot_be_solved_no_exponent_is_told(monkeypatch: pytest.MonkeyPatch, fails: float) -> None:
    def misfit(_: Capture, exponent: float) -> float:
        if exponent == fails:
            raise CaptureError("lights: wanted some, given none")
        return -exponent

    monkeypatch.setattr(mvps.curves, "misfit", misfit)
    assert exponent_left_in(lambda _: made(6, 0.003)) is None


def view_of(values: Float) -> Capture:
    """Pixels with these codes (pixels, lights), alike in all channels."""
    view = made(6, 0.003).views[0]
    mask = np.zeros_like(view.mask)
    mask[0, : len(values)] = True
    samples = np.repeat(np.asarray(values, np.uint16)[..., None], 3, axis=-1)
    return Capture("c", (replace(view, mask=mask, samples=samples, lights=tuple(range(1, values.shape[1] + 1))),))


def test_contrast_is_that_of_three_quarters() -> None:
    saturated = made(6, 0.003).views[0].saturation
    values = np.array([[100, 200, 10, 400], [300, 300, 0, saturated]])
    first = np.log((100**2 + 200**2 + 400**2) / 3) / 2 - np.log(100 * 200 * 400) / 3
    assert contrast(view_of(values)) == pytest.approx(first / 2)
    assert contrast(view_of(values[:1] * 3)) == pytest.approx(first)
    assert contrast(view_of(np.full((2, 4), saturated))) == np.inf
