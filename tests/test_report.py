"""The page: it parses, needs nothing else, shows what the metrics hold and leaves out what they do not."""

from __future__ import annotations

import base64
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from sphere_scene import SphereScene, make_sphere

import mvps.report.page
from mvps.joint import choosing, neural
from mvps.rendering import RAYS_ACROSS
from mvps.report import report_html, write_report
from mvps.report.charts import light_sphere, line_chart, pair_chart
from mvps.report.page import LARGEST_BYTES, STYLE, _components, _rounds, _truth
from mvps.report.pictures import ERROR_SPAN, EXPECTED_SPAN, LARGEST_SIDE, data_address, view_pictures
from mvps.report.pictures import LARGEST_BYTES as PICTURE_BYTES
from mvps.report.words import NOT_TRIED, reason
from mvps.scene import Capture, Lights
from mvps.visibility import RayCaster

METRICS: dict[str, Any] = {
    "stages": [
        {"name": "load", "seconds": 1.25, "peak_memory_mb": 812.5},
        {"name": "joint", "seconds": 20.0, "peak_memory_mb": 1500.0, "status": "5 rounds"},
    ],
    "rounds": [
        {"round": 1, "residual": 0.0321, "light_change_deg": 1.5, "normal_change_deg": 3.0, "vertex_change_px": 0.4},
        {"round": 2, "residual": 0.0123},
    ],
    "status": {"name": "converged", "text": "the step fell below the tolerance", "expected_deg": 2.5, "misfit": 0.0625},
    "model": {"components": [{"name": "lobes < 2 & more", "kept": True, "gain": 0.125, "noise": 0.025, "seconds": 3.5}]},
    "findings": [{"about": "photograph", "where": "view_03/007", "text": "is <black>", "mended": True}],
    "truth": {"chamfer_mm": 0.1875, "light_error_deg": 1.5},
}
SECTIONS = {
    "stages": "Time and memory",
    "rounds": "Rounds",
    "model": "Reflectance model",
    "findings": "Found in the capture",
    "status": "How good",
    "truth": "Against ground truth",
}


class Page(HTMLParser):
    """All tags with their attributes; complains where tags do not close in order."""

    VOID = frozenset({"meta", "img", "input", "br", "path", "circle", "polyline"})

    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.open: list[str] = []
        self.text: list[str] = []
        self.feed(html)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in self.VOID or (tag == "circle" and not self.rawdata[: self.rawdata.find(">")].endswith("/")):
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text.append(data)

    def all(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.tags if name == tag]


@pytest.fixture(scope="module")
def scene() -> SphereScene:
    made = make_sphere(3, side=RAYS_ACROSS)
    return made._replace(reconstruction=replace(made.reconstruction, metrics=METRICS))


@pytest.fixture(scope="module")
def html(scene: SphereScene) -> str:
    return report_html(scene.reconstruction, scene.capture)


def words(html: str) -> str:
    return " ".join(" ".join(Page(html).text).split())


def test_the_page_needs_nothing_else(html: str) -> None:
    page = Page(html)
    assert not page.open
    assert "http" not in html and "@import" not in html and "url(" not in html and "<link" not in html
    assert all("src" not in script for script in page.all("script")) and len(page.all("script")) == 4
    assert all(image["src"].startswith("data:image/jpeg;base64,") for image in page.all("img"))  # type: ignore[union-attr]
    assert len(html) < 15e6
    assert any(meta.get("name") == "viewport" for meta in page.all("meta"))


def test_a_large_model_keeps_to_what_the_page_may_have(scene: SphereScene, html: str, monkeypatch: pytest.MonkeyPatch) -> None:
    large = make_sphere(5).reconstruction
    large = replace(scene.reconstruction, surface=large.surface, material=large.material)
    monkeypatch.setattr(mvps.report.page, "LARGEST_BYTES", len(html) + 20_000)
    small = report_html(large, scene.capture)
    assert len(html) < len(small.encode()) <= len(html) + 20_000 and "faces; model.glb shows all of them" in small


def test_no_picture_takes_the_room_of_others() -> None:
    grain = np.random.default_rng(0).integers(0, 256, (LARGEST_SIDE, LARGEST_SIDE, 3), np.uint8)
    plain = np.full_like(grain, 128)
    letters = len(data_address(grain))
    assert PICTURE_BYTES / 2 < letters * 3 / 4 <= PICTURE_BYTES + 30
    assert len(data_address(plain)) < letters / 5
    assert 4 * 8 * PICTURE_BYTES * 4 / 3 < 0.6 * LARGEST_BYTES


def test_every_picture_has_words_and_decodes(html: str) -> None:
    page = Page(html)
    images = page.all("img")
    assert len(images) == 4 * 8
    for image in images:
        assert image["alt"] and len(image["alt"]) > 10
        data = base64.b64decode((image["src"] or "").partition(",")[2])
        decoded = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        assert decoded.shape[:2] == (int(image["height"] or 0), int(image["width"] or 0)) and max(decoded.shape) <= LARGEST_SIDE
    assert all(drawing.get("aria-label") for drawing in page.all("svg"))


def test_views_are_spread(html: str) -> None:
    assert re.findall(r"<h3>(view_\d+), light \d+</h3>", html) == ["view_01", "view_02", "view_04", "view_05"]


def test_numbers_are_shown(html: str) -> None:
    text = words(html)
    for shown in (
        *(
            "converged: the step fell below the tolerance",
            "21.2 s in all",
            "load 1.25",
            "20 1500 5 rounds",
            "0.0321",
            "0.0123",
            "lobes < 2 & more yes the error falls by 12 %, 5.0 standard errors 3.5",
        ),
        *(
            "normals: expected error, mean 2.5 deg",
            "share of the signal 6.25 %",
            "chamfer mm 0.1875",
            "light error deg 1.5",
            '"preset": "standard"',
            "60 photographs",
        ),
        *("Views", "Lights", "Settings", *SECTIONS.values()),
    ):
        assert shown in text.replace("  ", " "), shown


def test_held_out_photographs_are_told(scene: SphereScene) -> None:
    metrics = {"held_out": {"held_out_views_psnr_db": 31.5, "photograph_scale": 1.0}}
    text = words(report_html(replace(scene.reconstruction, metrics=metrics), scene.capture))
    assert "of views that were held back, against the model: mean PSNR inside the mask 31.5 dB" in text and "lights that were" not in text
    assert "No photographs were held back" not in text


def test_a_page_without_held_out_photographs_says_what_it_has_instead(scene: SphereScene) -> None:
    for status, said in (
        ({"misfit": 0.0625}, "No photographs were held back to test the result by; mvps.reconstruct does so with --hold-out-lights or"),
        ({"misfit": 0.0188, "noise": 0.015}, "the model leaves 1.9 % of the signal unexplained beside noise of 1.5 %"),
    ):
        assert said in words(report_html(replace(scene.reconstruction, metrics={"status": status}), scene.capture))


def facts(scene: SphereScene, **changes: Any) -> dict[str, str]:
    """What the page says of the capture."""
    html = report_html(replace(scene.reconstruction, metrics={}, **changes), scene.capture)
    return dict(re.findall("<dt>(.*?)</dt><dd>(.*?)</dd>", html))


def test_the_page_says_what_was_captured(scene: SphereScene) -> None:
    told = facts(scene, settings={"calibrated_lights": False, "hold_out_views": [2], "hold_out_lights": []})
    assert told == {
        "Views": "6, 1 of them held back",
        "Lights": "10 a view: one rig that stands still in the camera&#x27;s frame; solved from the photographs",
        "Photographs": "60",
        "Size of a photograph": "96 x 96 pixels",
        "Size of the object": "80 x 80 x 80 units",
        # A sphere of radius 40 fills four fifths of 96 pixels.
        "A pixel at the object": "1.04 units",
    }
    assert facts(scene, settings={"calibrated_lights": True})["Lights"].endswith("; taken from the capture&#x27;s calibration")
    r = scene.reconstruction
    assert "one rig that stands still in the world while the camera moves" in facts(scene, lights=replace(r.lights, fixed=True))["Lights"]
    fewer = Lights((r.lights.direction[0][:4], *r.lights.direction[1:]), (r.lights.intensity[0][:4], *r.lights.intensity[1:]), False)
    told = facts(scene, lights=fewer, light_names=((1, 2, 3, 4), *r.light_names[1:]), settings={})
    assert (told["Photographs"], told["Lights"]) == ("54", "4 to 10 a view: other ones in every view")


@pytest.mark.parametrize(
    ("component", "said"),
    [
        ({"name": "lobe", "kept": True, "gain": 0.135, "noise": 0.027}, "the error falls by 13 %, 5.0 standard errors"),
        ({"name": "lobe", "kept": False, "gain": 0.01, "noise": 0.02}, "the error falls by 1 %, 0.5 standard errors: that may be chance"),
        (
            {"name": "lobe", "kept": False, "gain": 0.01, "noise": 0.001},
            "the error falls by 1 % in the light or in shadow, and rises in the other",
        ),
        ({"name": "lobe", "kept": True, "gain": -0.01, "noise": 0.02}, "the error rises by 1 %, 0.5 standard errors: that may be chance"),
        ({"name": "lobe", "kept": False, "gain": -0.1, "noise": 0.1}, "the error rises by 11 %, 1.0 standard errors"),
        ({"name": "lobe", "kept": False, "gain": 0.0, "noise": 0.0}, "the error does not change"),
        ({"name": "net: not tried, too little fits badly", "kept": False, "gain": 0.0, "noise": 0.0}, "not tried: too little fits badly"),
        ({"name": "lobe", "kept": True}, ""),
    ],
)
def test_why_a_component_stays_or_goes(component: dict[str, Any], said: str) -> None:
    assert reason(component) == said
    page = Page(_components([component, {"name": f"net{NOT_TRIED}far"}]))
    assert said in page.text if said else "why" in page.text
    assert page.text[-1] == "not tried: far" and "net" in page.text


def test_sentences_have_room_on_a_phone() -> None:
    html = _components([{"name": "lobe", "kept": False, "gain": 0.01, "noise": 0.02, "seconds": 1.0}])
    assert '<th class="words">why</th>' in html and "<th>component</th>" in html and '<th class="number">time, s</th>' in html
    assert ".words{min-width:" in STYLE


def test_reasons_for_no_trial_are_told_apart_from_names() -> None:
    """The page knows them by how they are written."""
    assert NOT_TRIED in neural.NOT_TRIED and NOT_TRIED in Path(str(choosing.__file__)).read_text(encoding="utf-8")


@pytest.mark.parametrize("missing", SECTIONS)
def test_what_is_missing_is_left_out(scene: SphereScene, missing: str) -> None:
    metrics = {key: value for key, value in METRICS.items() if key != missing}
    text = words(report_html(replace(scene.reconstruction, metrics=metrics), scene.capture))
    assert SECTIONS[missing] not in text
    assert all(title in text for key, title in SECTIONS.items() if key != missing)


@pytest.mark.parametrize(
    "metrics",
    [
        {},
        {"stages": [], "rounds": [], "status": {}, "model": {}, "truth": {}},
        {
            "stages": [{"name": "load"}],
            "rounds": [{"round": 1}],
            "status": {"name": "stopped"},
            "model": {"components": [{"name": "Lambert"}]},
        },
        {"stages": [{"name": "load", "seconds": 0}], "truth": {"per view": [1, 2], "good": None}},
    ],
)
def test_sparse_metrics_make_a_page(scene: SphereScene, metrics: dict[str, Any]) -> None:
    page = Page(report_html(replace(scene.reconstruction, metrics=metrics, settings={}), scene.capture))
    assert not page.open and "Settings" not in " ".join(page.text)


def test_texts_are_escaped(scene: SphereScene) -> None:
    evil = '<img src=x onerror="alert(1)">'
    metrics = {"status": {"name": evil}, "stages": [{"name": evil, "seconds": 1.0, "status": evil}], "truth": {evil: evil}}
    changed = replace(scene.reconstruction, metrics=metrics, settings={evil: evil})
    html = report_html(changed, Capture(evil, scene.capture.views))
    assert evil not in html and all("onerror" not in image for image in Page(html).all("img"))


def test_views_and_lights_that_the_result_lacks_are_not_shown(scene: SphereScene) -> None:
    r = scene.reconstruction
    fewer = replace(
        r,
        views=r.views[:1],
        light_names=((7, 9),),
        normal_maps=r.normal_maps[:1],
        lights=Lights((r.lights.direction[0][[6, 8]],), (r.lights.intensity[0][[6, 8]],), False),
    )
    html = report_html(fewer, scene.capture)
    assert re.findall(r"<h3>(.*?)</h3>", html) in (["view_01, light 7"], ["view_01, light 9"])
    none = report_html(fewer, Capture("others", scene.capture.views[1:]))
    assert "<img" not in none and "<h2>Views" not in none and "<h2>Lights" not in none and "Size of a photograph" not in none


def test_pictures_show_what_they_say(scene: SphereScene) -> None:
    """Photographs by the same image model: the error is black, the photograph and the re-rendering agree."""
    light, pictures = view_pictures(RayCaster(scene.reconstruction.surface), None, scene.reconstruction, scene.capture.views[4])
    by_title = {picture.title: picture for picture in pictures}
    assert light.startswith("light ") and len(by_title) == 8
    error = by_title[f"error, white = {100 * ERROR_SPAN:.0f} %"]
    assert "mean absolute error 0.0 % of white" in error.text
    difference = by_title["photograph"].image.astype(int) - by_title["re-rendering"].image
    assert np.abs(difference).max() <= 2
    middle = tuple(s // 2 for s in error.image.shape[:2])
    assert by_title["normals"].image[middle][2] > 240 and (by_title["shadow"].image[middle] == 255).all()
    assert (error.image[middle] <= 1).all()
    wrong = replace(scene.reconstruction, material=replace(scene.reconstruction.material, albedo=scene.reconstruction.material.albedo * 3))
    _, pictures = view_pictures(RayCaster(wrong.surface), None, wrong, scene.capture.views[4])
    assert pictures[2].image[middle].max() == 255


def test_the_expected_error_is_that_of_the_confidence(scene: SphereScene) -> None:
    r, view = scene.reconstruction, scene.capture.views[4]
    for confidence, said, shown in ((0.5, "median 14.4 deg", False), (0.0, "median 20.0 deg", True)):
        material = replace(r.material, confidence=np.full(len(r.surface.vertices), confidence))
        _, pictures = view_pictures(RayCaster(r.surface), None, replace(r, material=material), view)
        (picture,) = (p for p in pictures if p.title == f"expected error of normals, white = {EXPECTED_SPAN:.0f} deg")
        assert said in picture.text
        middle = picture.image[tuple(s // 2 for s in picture.image.shape[:2])]
        assert (middle.min() == 255) == shown and middle[0] == 255


def test_chart_draws_the_values() -> None:
    html = line_chart([4.0, 2.0, 1.0], "123", "round", "residual")
    points = [tuple(map(float, p.split(","))) for p in re.findall(r'points="(.*?)"', html)[0].split()]
    heights = [y for _, y in points]
    base = 12 + (4.0 / 4.0) * (heights[0] - 12) if heights[0] > 12 else 12
    assert base == 12 and heights[0] < heights[1] < heights[2]
    # Zero lies on the axis, so heights above it are in proportion to the values.
    zero = 2 * heights[1] - heights[0]
    assert (zero - heights[2]) / (zero - heights[0]) == pytest.approx(0.25, abs=0.01)
    for values in ([1.0], [0.0, 0.0], [-1.0, 1.0]):
        assert not Page(line_chart(values, ["<"] * len(values), "a", "b")).open


def test_rounds_keep_their_numbers_in_the_chart() -> None:
    """Through all stages, of which every one counts from one."""
    html = _rounds([{"round": 1.0}, {"round": 2.0, "residual": 0.5}, {"round": 1.0, "residual": 0.25}])
    ticks = dict(re.findall(r'<text x="([\d.]+)"[^>]*text-anchor="middle">(\d)</text>', html))
    dots = re.findall(r'<circle cx="([\d.]+)"[^>]*><title>(.*?)</title>', html)
    assert list(ticks.values()) == ["1", "2", "3"]
    assert [(ticks[x], said) for x, said in dots] == [("2", "round 2: 0.5"), ("3", "round 3: 0.25")]


def test_lights_lie_where_the_camera_sees_them() -> None:
    direction = np.array([[0.6, 0, 0.8], [0, 0.6, 0.8], [0, 0, 1.0], [1, 0, 0], [0, -0.6, -0.8]])
    html = light_sphere(direction, np.ones((5, 3)), (1, 2, 3, 4, 5), "view_01")
    marks = {re.findall(r"light (\d)", m)[0]: m for m in re.findall(r'<circle class="light".*?</circle>', html)}
    assert 'cx="60.0" cy="-0.0"' in marks["1"] and 'cx="0.0" cy="-60.0"' in marks["2"] and "37 degrees" in marks["2"]
    # White lights lie on a dark disc, the ring of 90 degrees.
    assert html.index('r="100.0"') < html.index('r="86.6"') and ".ring:first-child{fill:#333}" in STYLE
    assert 'fill="none"' in marks["5"] and 'fill="none"' not in marks["4"]


def test_write_is_whole_and_repeatable(scene: SphereScene, html: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_report(scene.reconstruction, scene.capture, tmp_path / "report.html")
    assert (tmp_path / "report.html").read_text(encoding="utf-8") == html

    def fails(*_: object) -> str:
        raise KeyboardInterrupt

    monkeypatch.setattr(mvps.report.page, "report_html", fails)
    with pytest.raises(KeyboardInterrupt):
        write_report(scene.reconstruction, scene.capture, tmp_path / "report.html")
    assert list(tmp_path.iterdir()) == [tmp_path / "report.html"] and (tmp_path / "report.html").read_text(encoding="utf-8") == html


def test_confidence_is_drawn_and_not_listed() -> None:
    pairs = {f"confidence_{kind}_{k:02d}_deg": k * f for k in (1, 2) for kind, f in (("stated", 1.0), ("measured", 1.5))}
    html = _truth({"chamfer_mm": 0.2, **pairs})
    assert html.count("<title>") == 2 and "1, 1.5" in html and "confidence stated" not in html
    assert not Page(pair_chart([(1.0, 1.0)], "a", "b")).open
