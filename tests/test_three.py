"""model.glb in three.js, the renderer of most web viewers, in headless Chromium: the picture is the one that we render."""

from __future__ import annotations

import base64
import json
import shutil
import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from sphere_scene import make_sphere
from test_browser import OPTIONS

from mvps.export import write_reconstruction
from mvps.illumination import Illumination
from mvps.layers import rendered
from mvps.scene import Camera
from mvps.texture import bake
from mvps.visibility import ray_caster

pytestmark = pytest.mark.browser

THREE = Path(__file__).resolve().parents[1] / "node_modules" / "three"
NEAR, FAR = 0.1, 1000.0
BAR = 28.0
"""dB."""

PAGE = """<!DOCTYPE html><html><head><link rel="icon" href="data:,">
<script type="importmap">{"imports": {"three": "/three/build/three.module.js", "addons/": "/three/examples/jsm/"}}</script></head>
<body><script type="module">
import * as THREE from "three";
import { GLTFLoader } from "addons/loaders/GLTFLoader.js";
const about = JSON.parse(decodeURIComponent(location.hash.slice(1)));
const renderer = new THREE.WebGLRenderer({ antialias: true, preserveDrawingBuffer: true });
renderer.setPixelRatio(1);
renderer.setSize(about.width, about.height);
const scene = new THREE.Scene();
scene.add((await new GLTFLoader().loadAsync("/model.glb")).scene);
const light = new THREE.DirectionalLight(new THREE.Color(...about.colour), 1);
light.position.set(...about.direction);
scene.add(light);
const camera = new THREE.PerspectiveCamera();
camera.matrixAutoUpdate = false;
camera.matrix.set(...about.world_from_camera.flat());
camera.updateMatrixWorld(true);
camera.projectionMatrix.set(...about.projection.flat());
camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
renderer.render(scene, camera);
window.picture = renderer.domElement.toDataURL("image/png");
</script></body></html>"""


def as_three(camera: Camera) -> dict[str, Any]:
    """The camera in OpenGL's axes: x right, y up, looking along -z."""
    world_from_camera = np.eye(4)
    world_from_camera[:3, :3] = camera.rotation.T @ np.diag([1.0, -1.0, -1.0])
    world_from_camera[:3, 3] = camera.centre
    (fx, _, cx), (_, fy, cy), _ = camera.K
    projection = np.zeros((4, 4))
    projection[0, [0, 2]] = 2 * fx / camera.width, 1 - 2 * cx / camera.width
    projection[1, [1, 2]] = 2 * fy / camera.height, 2 * cy / camera.height - 1
    projection[2, [2, 3]] = -(FAR + NEAR) / (FAR - NEAR), -2 * FAR * NEAR / (FAR - NEAR)
    projection[3, 2] = -1
    return {
        "width": camera.width,
        "height": camera.height,
        "world_from_camera": world_from_camera.tolist(),
        "projection": projection.tolist(),
    }


def linear(image: np.ndarray) -> np.ndarray:
    """Of sRGB bytes."""
    code = image / 255
    return np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)


@pytest.mark.node
def test_three_shows_the_file_as_we_render_it(tmp_path: Path) -> None:
    from playwright.sync_api import sync_playwright

    assert THREE.is_dir(), "npm install three, as .ci/run does"
    scene = make_sphere(coloured_lobes=True, tint=(1.0, 0.7, 0.4), waves=0.2)
    r, camera = scene.reconstruction, scene.capture.views[0].camera
    textures = bake(r.surface, r.material, r.lights, scene.capture, 2)[0]
    write_reconstruction(r, tmp_path / "result", textures)
    (tmp_path / "three").symlink_to(THREE)
    shutil.copy(tmp_path / "result" / "model.glb", tmp_path)
    (tmp_path / "page.html").write_text(PAGE, encoding="utf-8")
    light = Illumination(r.lights.direction[0][:1], r.lights.intensity[0][:1])
    layers, coverage = rendered(ray_caster(r.surface), r.material, camera, light, ("image",))
    ours, inside = layers["image"], coverage == 1
    white = float(np.quantile(ours[inside], 0.999))

    def shown(page: Any, direction: np.ndarray) -> np.ndarray:
        """What three.js makes of the file, linear, over `white`."""
        # glTF's reflectance is ours over pi times the scale.
        about = as_three(camera) | {
            "direction": direction.tolist(),
            "colour": (np.pi * textures.scale * light.intensity[0] / white).tolist(),
        }
        page.goto("about:blank")
        page.goto(f"http://127.0.0.1:{serving.server_port}/page.html#{json.dumps(about)}")
        page.wait_for_function("window.picture")
        coded = base64.b64decode(page.evaluate("window.picture").partition(",")[2])
        return linear(np.asarray(cv2.imdecode(np.frombuffer(coded, np.uint8), cv2.IMREAD_COLOR))[..., ::-1])

    def gap(picture: np.ndarray) -> float:
        return float(-10 * np.log10(((picture - np.minimum(ours / white, 1))[inside] ** 2).mean()))

    class Quiet(SimpleHTTPRequestHandler):
        def log_message(self, format: str, *values: object) -> None:
            """Nothing."""

    said: list[str] = []
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(tmp_path))) as serving, sync_playwright() as playwright:
        threading.Thread(target=serving.serve_forever, daemon=True).start()
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=OPTIONS)
        page = browser.new_page()
        page.on("console", lambda message: said.append(message.text) if message.type == "error" else None)
        page.on("pageerror", lambda error: said.append(str(error)))
        picture = shown(page, light.direction[0])
        aside = shown(page, light.direction[0] + 0.3 * camera.rotation[0])
        browser.close()
        serving.shutdown()
    assert not said
    # three.js lets all light into the body, of which glTF takes off what the surface reflects: here up to a tenth.
    a, b = picture[inside], np.minimum(ours / white, 1)[inside]
    undimmed = float((a * b).sum() / (a * a).sum())
    assert gap(picture) > BAR > gap(aside) + 3
    assert 0.9 < undimmed <= 1 and gap(undimmed * picture) > BAR + 5
