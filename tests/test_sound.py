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
from mvps.synthetic.scene import render_capture
from mvps.synthetic.settings import SceneSettings


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


@pytest.fixture(scope="module")
def made() -> Capture:
    return render_capture(SceneSettings(views=6, lights=8, size=72))[0]


def shifted(capture: Capture, at: int, rows: int, columns: int) -> Capture:
    """The pictures of one view moved, which its camera is not."""
    view = capture.views[at]
    image = np.zeros((*view.mask.shape, *view.samples.shape[1:]), np.uint16)
    image[view.mask] = view.samples
    mask, image = (np.roll(of, (rows, columns), (0, 1)) for of in (view.mask, image))
    views = [replace(view, mask=mask, samples=image[mask]) if k == at else of for k, of in enumerate(capture.views)]
    return Capture(capture.name, tuple(views))


def test_views_that_are_kept_back_have_no_part_in_what_becomes_of_the_others(made: Capture) -> None:
    """A view beside its place moves the cameras of all where it is one of them."""
    wrong = shifted(made, 3, 1, 2)
    free, apart, clean = sound(wrong, Progress())[0], sound(wrong, Progress(), [4])[0], sound(made, Progress(), [4])[0]
    cameras = [[view.camera.translation.tolist() for view in of.views] for of in (free, apart, clean)]
    assert cameras[0][:3] != cameras[2][:3]
    assert cameras[1][:3] + cameras[1][4:] == cameras[2][:3] + cameras[2][4:]
    assert [view.name for view in apart.views] == [view.name for view in made.views]


def test_a_view_that_would_be_left_out_may_be_kept_back(made: Capture) -> None:
    upright, turned = made.views[3], replace(made.views[3], camera=made.views[0].camera)
    wrong = Capture(made.name, (*made.views[:3], turned, *made.views[4:]))
    assert [view.name for view in sound(wrong, Progress())[0].views if view.name == upright.name] == []
    kept, findings = sound(wrong, Progress(), [4])
    assert kept.views[3] is turned and kept.views[0] is made.views[0]
    assert [(one.where, one.mended) for one in findings] == [(upright.name, True)] and findings[0].text.startswith("kept back: ")


def test_views_that_are_all_kept_back_are_mended_as_any(made: Capture) -> None:
    every = [int(view.name[5:]) for view in made.views]
    assert sound(made, Progress(), every) == sound(made, Progress())


def test_lights_that_are_known_to_differ_are_not_held_against_each_other(made: Capture) -> None:
    """Two photographs that a view names the other way round: a fault under one rig, none where its lights were given so."""
    samples = made.views[2].samples.copy()
    samples[:, [1, 6]] = samples[:, [6, 1]]
    other = Capture(made.name, tuple(replace(view, samples=samples) if k == 2 else view for k, view in enumerate(made.views)))
    assert {one.where for one in sound(other, Progress())[1]} == {"view_03/002", "view_03/007"}
    assert sound(other, Progress(), one_rig=False) == (other, [])
