"""The viewer in a browser: it draws, the picture changes when light or object move, and nothing is said on the console."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from sphere_scene import SphereScene, make_sphere

from mvps.compare.curve import Point, drawing
from mvps.compare.page import page_html
from mvps.compare.tables import COLUMNS
from mvps.report import report_html
from mvps.scene import Surface
from mvps.view import Model, server
from mvps.viewer import STYLE, viewer_html

pytestmark = pytest.mark.browser

Opened = Callable[[str], tuple[Any, list[str]]]

OPTIONS = [
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--disable-background-networking",
]


@pytest.fixture(scope="module")
def scene() -> SphereScene:
    return make_sphere(4)


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=OPTIONS)
        yield chromium
        chromium.close()


@pytest.fixture
def opened(browser: Any) -> Iterator[Opened]:
    """A page of an address, and what it has said on its console."""
    pages = []

    def open_(address: str) -> tuple[Any, list[str]]:
        page, said = browser.new_page(viewport={"width": 700, "height": 700}), []
        pages.append(page)
        page.on("console", lambda message: said.append(message.text) if message.type in ("error", "warning") else None)
        page.on("pageerror", lambda error: said.append(str(error)))
        page.goto(address)
        page.wait_for_function("Number(document.getElementById('viewer').dataset.drawn || 0) > 0")
        return page, said

    yield open_
    for page in pages:
        page.close()


def shown(page: Any) -> np.ndarray:
    """The canvas once it has drawn what was asked for."""
    page.wait_for_timeout(300)
    data = page.locator("#viewer").screenshot()
    image: np.ndarray = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR).astype(float)
    # Where the page is scrolled to decides what the outermost rows show.
    return image[4:-4, 4:-4]


PINCH = """() => {
const canvas = document.getElementById("viewer"), box = canvas.getBoundingClientRect();
canvas.setPointerCapture = () => {};
const at = (kind, id, x) => canvas.dispatchEvent(new PointerEvent(kind, {
    pointerId: id, pointerType: "touch", clientX: box.left + x, clientY: box.top + 100, bubbles: true }));
at("pointerdown", 7, 100); at("pointerdown", 8, 200);
for (const x of [220, 240, 260]) at("pointermove", 8, x);
at("pointerup", 8, 260); at("pointerup", 7, 100);
}"""
"""Fingers 100 pixels apart, then 160."""


def test_the_report_shows_the_model_without_a_server(
    scene: SphereScene, tmp_path: Path, opened: Callable[[str], tuple[Any, list[str]]]
) -> None:
    path = tmp_path / "report.html"
    path.write_text(report_html(scene.reconstruction, scene.capture), encoding="utf-8")
    page, said = opened(path.as_uri())
    first = shown(page)
    middle = first[first.shape[0] // 2, first.shape[1] // 2]
    assert middle.max() > 60 and first[0, 0].max() < 40
    page.locator("#viewer").focus()
    for _ in range(6):
        page.keyboard.press("Shift+ArrowLeft")
    lit = shown(page)
    assert np.abs(lit - first).mean() > 2
    page.locator("#viewer").drag_to(page.locator("#viewer"), source_position={"x": 100, "y": 100}, target_position={"x": 220, "y": 100})
    assert np.abs(shown(page) - lit).mean() > 1
    before = shown(page)
    page.locator("#viewer-more").click()
    two = shown(page)
    assert np.quantile(two - before, 0.01) >= 0 and (two - before).mean() > 2, "a second light adds light"
    page.locator("#viewer-colour").fill("#ff0000")
    red = shown(page)
    # Blue, green, red.
    assert (red - two)[..., :2].mean() < -1 and abs((red - two)[..., 2].mean()) < 0.5
    page.locator("#viewer-fewer").click()
    assert np.abs(shown(page) - before).mean() < 0.1
    page.select_option("#viewer-layer", "normals")
    assert np.abs(shown(page) - lit).mean() > 5
    page.select_option("#viewer-layer", "shadow")
    grey = shown(page)
    assert np.ptp(grey, axis=-1).max() < 2 and (grey < 5).mean() > 0.05 and (grey > 60).mean() < 0.02, "no part of a ball hides the light"
    page.select_option("#viewer-layer", "depth")
    near = shown(page)
    assert np.ptp(near, axis=-1).max() < 2 and near.max() > 100 and near.std() > 10
    page.select_option("#viewer-layer", "image")
    before = (shown(page) > 60).mean()
    page.evaluate(PINCH)
    assert (shown(page) > 60).mean() > 1.3 * before, "two fingers that part bring the object nearer"
    picture = page.locator("main figure img").first
    small = picture.bounding_box()["width"]
    picture.click()
    assert picture.bounding_box()["width"] > 2 * small
    picture.click()
    assert picture.bounding_box()["width"] == small
    page.set_viewport_size({"width": 360, "height": 640})
    places = [page.locator("main figure img").nth(k).bounding_box() for k in range(2)]
    assert places[0]["y"] == places[1]["y"], "two pictures stand beside each other on a phone"
    assert not said


def test_a_model_far_from_the_origin_looks_the_same(scene: SphereScene, tmp_path: Path, opened: Opened) -> None:
    """Through a photograph's camera too."""
    surface, pictures = scene.reconstruction.surface, []
    for away in (0.0, 1e6 * np.ptp(surface.vertices) * np.array([0.5, 0.8, 0.2])):
        path = tmp_path / f"{len(pictures)}.html"
        part = viewer_html(Surface(surface.vertices + away, surface.faces), scene.reconstruction.material, np.eye(3)[2], np.eye(3)[0])
        path.write_text(f'<!DOCTYPE html><meta charset="utf-8"><style>{STYLE}</style>{part}', encoding="utf-8")
        page, said = opened(path.as_uri())
        first = shown(page)
        page.evaluate("camera => window.mvpsViewer.look(camera)", ROLLED | {"eye": (np.array(ROLLED["eye"]) + away).tolist()})
        pictures.append((first, shown(page)))
        assert not said
    for near, far in zip(*pictures, strict=True):
        assert near.std() > 10 and np.abs(near - far).mean() < 0.1


def traced_over(page: Any) -> None:
    """What rests is traced ray by ray, and shows what the graphics processor shows: where the whole ball is lit they hardly differ."""
    page.wait_for_function("!document.getElementById('viewer-exact').hidden", timeout=60_000)
    drawn = shown(page)
    page.evaluate("document.getElementById('viewer-exact').style.visibility = 'visible'")
    traced = shown(page)
    page.evaluate("document.getElementById('viewer-exact').style.visibility = 'hidden'")
    difference = np.abs(traced - drawn).max(axis=-1)
    assert 0 < difference.mean() < 2 and np.quantile(difference, 0.9) < 4


def test_the_server_s_page_has_exact_shadows_and_photographs(scene: SphereScene, opened: Opened) -> None:
    with server(Model(scene.reconstruction, scene.capture), 0) as serving:
        threading.Thread(target=serving.serve_forever, daemon=True).start()
        page, said = opened(f"http://127.0.0.1:{serving.server_port}/")
        page.wait_for_function("Number(document.getElementById('viewer').dataset.traced || 0) > 0")
        page.evaluate("document.getElementById('viewer-exact').style.visibility = 'hidden'")
        first = shown(page)
        page.select_option("#photograph", index=15)
        page.wait_for_function("document.getElementById('beside').naturalWidth > 0")
        lit = shown(page)
        assert np.abs(lit - first).mean() > 2
        page.select_option("#viewer-environment", "studio")
        page.wait_for_function("Number(document.getElementById('viewer').dataset.surrounded || 0) > 0")
        around = shown(page)
        assert np.quantile(around - lit, 0.01) >= 0 and (around - lit).mean() > 2
        page.locator("#viewer-turn").fill("180")
        page.wait_for_function("Number(document.getElementById('viewer').dataset.surrounded || 0) > 1")
        assert np.abs(shown(page) - around).mean() > 1
        traced_over(page)
        turned = shown(page)
        page.select_option("#viewer-material", "gold")
        page.wait_for_function("Number(document.getElementById('viewer').dataset.dressed || 0) > 0")
        assert np.abs(shown(page) - turned).mean() > 2
        traced_over(page)
        page.select_option("#viewer-material", "as solved")
        page.wait_for_function("Number(document.getElementById('viewer').dataset.dressed || 0) > 1")
        assert np.abs(shown(page) - turned).mean() < 0.1
        page.evaluate("window.mvpsViewer.lightFrom([0, 0, 1], [1, 0.8, 0.6])")
        assert page.locator("#viewer-environment").input_value() == "" and page.locator("#viewer-colour").input_value() == "#ffe7cb"
        assert page.locator("#viewer-exact").get_attribute("hidden") is not None, "what it showed is no longer so"
        traced_over(page)
        serving.shutdown()
    assert not said


def test_the_first_photograph_is_taken_over_at_once(scene: SphereScene, opened: Opened) -> None:
    """The picture that coming back to it gives."""
    with server(Model(scene.reconstruction, scene.capture), 0) as serving:
        threading.Thread(target=serving.serve_forever, daemon=True).start()
        page, said = opened(f"http://127.0.0.1:{serving.server_port}/")
        page.evaluate("document.getElementById('viewer-exact').style.visibility = 'hidden'")
        first = shown(page)
        assert page.locator("#viewer-fill").input_value() == "0" and page.evaluate("document.getElementById('beside').naturalWidth > 0")
        for index in (3, 0):
            page.select_option("#photograph", index=index)
            again = shown(page)
        assert np.abs(first - again).mean() < 0.1
        serving.shutdown()
    assert not said


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_curves_are_read_on_their_paper_and_leave_the_page_alone(tmp_path: Path, browser: Any, scheme: str) -> None:
    curve = drawing([Point(10, 0.1, "ours"), Point(100, 0.3, "hull")], COLUMNS[4])
    path, style = tmp_path / "page.html", "getComputedStyle(document.querySelector('{}')).{}"
    path.write_text(page_html("x", {"ours": [["a", "b"], ["1", "2"]]}, {"c": curve, "d": '<svg id="d"><text>x</text></svg>'}, None))
    page = browser.new_page(color_scheme=scheme)
    page.goto(path.as_uri())
    assert page.evaluate(style.format("svg.curve text", "fill")) == "rgb(34, 34, 34)"
    assert page.evaluate(style.format("svg.curve .axis", "stroke")) == "rgb(34, 34, 34)"
    assert page.evaluate(style.format("#d text", "fill")) == page.evaluate(style.format("body", "color"))
    assert page.evaluate(style.format("#d text", "fontFamily")) == page.evaluate(style.format("body", "fontFamily"))
    page.close()


ROLLED = {"eye": [80.0, 0, 0], "forward": [-1.0, 0, 0], "above": [0.0, 1, 0], "focal": [100.0, 100], "middle": [32.0, 24], "size": [64, 48]}
"""A camera that holds the world's y upwards, where the page holds its z."""


def test_a_lost_picture_is_said_and_comes_back(scene: SphereScene, opened: Opened) -> None:
    """With the material and the environment that were chosen."""
    with server(Model(scene.reconstruction, None), 0) as serving:
        threading.Thread(target=serving.serve_forever, daemon=True).start()
        page, _ = opened(f"http://127.0.0.1:{serving.server_port}/")
        page.evaluate("document.getElementById('viewer-exact').style.visibility = 'hidden'")
        page.select_option("#viewer-material", "gold")
        page.select_option("#viewer-environment", "studio")
        page.wait_for_function("['surrounded', 'dressed', 'traced'].every((name) => document.getElementById('viewer').dataset[name])")
        before = shown(page)
        page.evaluate("window.lose = document.getElementById('viewer').getContext('webgl2').getExtension('WEBGL_lose_context')")
        page.evaluate("window.lose.loseContext()")
        page.wait_for_function("document.getElementById('viewer-said').textContent.startsWith('The graphics processor has lost')")
        page.locator("#viewer").focus()
        page.keyboard.press("ArrowLeft")
        page.keyboard.press("ArrowRight")
        page.evaluate("window.lose.restoreContext()")
        page.wait_for_function("document.getElementById('viewer-said').textContent === ''")
        assert before.std() > 10 and np.abs(shown(page) - before).mean() < 0.1
        serving.shutdown()


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("away_deg", [0, 2])
def test_a_view_from_above_or_below_can_be_tilted(scene: SphereScene, opened: Opened, side: int, away_deg: float) -> None:
    """A photograph along the axis that the object is turned about: the model stays in sight, as it was, and follows both ways."""
    with server(Model(scene.reconstruction, None), 0) as serving:
        threading.Thread(target=serving.serve_forever, daemon=True).start()
        page, said = opened(f"http://127.0.0.1:{serving.server_port}/")
        page.evaluate("document.getElementById('viewer-exact').style.visibility = 'hidden'")
        page.select_option("#viewer-layer", "normals")
        angle = np.radians(away_deg)
        # Upwards in the picture is the world's x.
        direction, above = side * np.array([-np.sin(angle), 0, np.cos(angle)]), np.array([np.cos(angle), 0, np.sin(angle)])
        lens = {"focal": [384.0, 384], "middle": [48.0, 48], "size": [96, 96]}
        through = {"eye": (250 * direction).tolist(), "forward": (-direction).tolist(), "above": above.tolist()} | lens
        page.evaluate("camera => window.mvpsViewer.look(camera)", through)
        box = page.locator("#viewer").bounding_box()
        x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        pictures = []
        # The first move leaves the photograph's camera, and turns the model a little; the others tilt it, and part of the way back.
        for across, down in ((9, 0), (0, -75 * side), (0, 45 * side)):
            page.mouse.move(x, y)
            page.mouse.down()
            page.mouse.move(x + across, y + down, steps=abs(across + down) // 3)
            page.mouse.up()
            pictures.append(shown(page))
        # The normal in the middle, towards the eye: red, green and blue are (n + 1) / 2 of x, y and z.
        middle = [picture[picture.shape[0] // 2, picture.shape[1] // 2, ::-1] / 127.5 - 1 for picture in pictures]
        near, away, back = (side * float(n[2]) for n in middle)
        assert near > 0.95 and away < 0.9 and away + 0.03 < back < near
        # Upwards in the picture is the world's x still: normals lean there.
        top, bottom = (pictures[0][round(part * pictures[0].shape[0]), pictures[0].shape[1] // 2, 2] for part in (0.4, 0.6))
        assert top > bottom + 20
        serving.shutdown()
    assert not said


def test_light_follows_the_hand_in_any_photograph(scene: SphereScene, opened: Opened) -> None:
    """To the right on the screen, however the photograph's camera was rolled."""
    with server(Model(scene.reconstruction, None), 0) as serving:
        threading.Thread(target=serving.serve_forever, daemon=True).start()
        page, said = opened(f"http://127.0.0.1:{serving.server_port}/")
        page.evaluate("document.getElementById('viewer-exact').style.visibility = 'hidden'")
        page.evaluate("camera => { window.mvpsViewer.look(camera); window.mvpsViewer.lightFrom([1, 0, 0], [1, 1, 1]); }", ROLLED)
        before = shown(page).mean(-1)
        page.locator("#viewer").focus()
        for _ in range(6):
            page.keyboard.press("Shift+ArrowRight")
        change = shown(page).mean(-1) - before
        down, across = np.indices(change.shape)
        along, aside = ((at - at.mean()) * change for at in (across, down))
        assert along.sum() > 5 * abs(aside.sum()) > 0
        serving.shutdown()
    assert not said
