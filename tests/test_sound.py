"""mvps.sound: checks in their order, each on what those before it made of the capture."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from sphere_scene import make_sphere

import mvps.sound
from mvps.checks.contents import contents
from mvps.finding import Finding
from mvps.progress import Progress
from mvps.scene import Capture, CaptureError
from mvps.sound import sound


def test_each_check_gets_what_those_before_it_made(monkeypatch: pytest.MonkeyPatch) -> None:
    def renamed(capture: Capture) -> tuple[Capture, list[Finding]]:
        return Capture(f"{capture.name}+", capture.views), [Finding("view", capture.name, "seen", True)]

    for checks in ("OF_VALUES", "OF_LINEAR"):
        monkeypatch.setattr(mvps.sound, checks, (renamed,))
    capture, progress = make_sphere().capture, Progress()
    after, findings = sound(capture, progress)
    assert after.name == f"{capture.name}++"
    assert [one.where for one in findings] == [capture.name, f"{capture.name}+"]
    assert f"{capture.name}+: seen" in progress.stages[0]["status"]


@pytest.mark.parametrize(
    ("value", "said"),
    [
        (0, "view_02: wanted photographs that show the object inside the mask, given nothing but black"),
        (65535, "view_02: wanted photographs that show the object inside the mask, given nothing but clipped samples"),
    ],
)
def test_a_view_that_shows_nothing_is_refused(value: int, said: str) -> None:
    capture = make_sphere().capture
    samples = np.full_like(capture.views[1].samples, value)
    with pytest.raises(CaptureError, match=said):
        contents(Capture("c", (capture.views[0], replace(capture.views[1], samples=samples))))


def test_a_photograph_that_is_clipped_throughout_is_named() -> None:
    view = make_sphere().capture.views[0]
    samples = view.samples.copy()
    samples[:, 1] = view.saturation
    capture, findings = contents(Capture("c", (replace(view, samples=samples),)))
    assert [(one.about, one.where, one.mended) for one in findings] == [("photograph", f"view_01/{view.lights[1]:03d}", True)]
    assert np.array_equal(capture.views[0].samples, samples)


def test_a_colour_that_is_nowhere_is_refused() -> None:
    capture = make_sphere().capture
    without = tuple(replace(view, samples=view.samples * np.array([1, 0, 1], np.uint16)) for view in capture.views)
    with pytest.raises(CaptureError, match="given no green in any"):
        contents(Capture("c", without))
    assert contents(Capture("c", (capture.views[0], without[1])))[1] == []


def test_an_object_of_a_few_pixels_is_refused() -> None:
    view = make_sphere().capture.views[0]
    mask, few = np.zeros_like(view.mask), view.pixels[:63]
    mask[tuple(few.T)] = True
    with pytest.raises(CaptureError, match=r"view_01/mask.png: wanted an object of 64 pixels and more, given 63"):
        contents(Capture("c", (replace(view, mask=mask, samples=view.samples[:63]),)))
