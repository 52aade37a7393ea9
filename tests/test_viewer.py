"""mvps.viewer and mvps.view: the data that the page holds is the model, and the server answers what the page asks."""

from __future__ import annotations

import base64
import json
import re
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
import zlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.error import HTTPError
from urllib.parse import urlencode
from urllib.request import urlopen

import cv2
import numpy as np
import pytest
from sphere_scene import RADIUS, SphereScene, colours, make_sphere

from mvps.command import run
from mvps.export import write_reconstruction
from mvps.illumination import Illumination, environment_lights
from mvps.layers import rendered
from mvps.mesh import decimated, normalise
from mvps.pbr import srgb_bytes
from mvps.scene import Surface
from mvps.view import Model, main, named, server
from mvps.viewer import carried_over, packed, viewer_html
from mvps.viewer.environments import MADE, made
from mvps.viewpoints import look_at
from mvps.visibility import RayCaster

UP, FROM = np.array([0.0, 0, 1]), np.array([1.0, 0, 0])


@pytest.fixture(scope="module")
def scene() -> SphereScene:
    return make_sphere(3, coloured_lobes=True, tint=(1.0, 0.8, 0.4))


def test_the_page_holds_the_model(scene: SphereScene) -> None:
    r = scene.reconstruction
    html = viewer_html(r.surface, r.material, UP, FROM)
    about = json.loads(re.search(r'id="viewer-about">(.*?)</script>', html)[1])  # type: ignore[index]
    data = zlib.decompress(base64.b64decode(re.search(r'id="viewer-data">(.*?)</script>', html)[1]))  # type: ignore[index]
    V, F = about["vertices"], about["faces"]
    assert (len(r.surface.vertices), len(r.surface.faces)) == (V, F) and len(data) == 23 * V + 12 * F
    parts = np.split(np.frombuffer(data, np.uint8), np.cumsum([6 * V, 6 * V, 3 * V, 4 * V, 3 * V, V]))
    low, high = np.array(about["low"]), np.array(about["high"])
    position = np.array(about["centre"]) + low + parts[0].view("<u2").reshape(V, 3) / 65535 * (high - low)
    np.testing.assert_allclose(position, r.surface.vertices, atol=1e-3)
    np.testing.assert_allclose(parts[1].view("<i2").reshape(V, 3) / 32767, r.material.normal, atol=1e-4)
    np.testing.assert_allclose((parts[2].reshape(V, 3) / 255) ** 2 * about["white"], r.material.albedo, atol=0.01)
    weight = (parts[3].reshape(V, 4) / 255) ** 2 * about["lobe_white"]
    hue = (parts[4].reshape(V, 1, 3) / 255) ** 2 * about["hue_white"]
    coloured = weight[:, :2, None] * np.array(about["tint"])[:2] * hue
    np.testing.assert_allclose(coloured, r.material.specular_weight, atol=0.005)
    assert about["sharpness"][:2] == [12, 60] and not weight[:, 2:].any()
    np.testing.assert_array_equal(parts[6].view("<u4").reshape(F, 3), r.surface.faces)


def test_a_model_far_from_the_origin_is_the_same_in_single_precision(scene: SphereScene) -> None:
    r = scene.reconstruction
    away = 1e6 * RADIUS * np.array([0.5, 0.8, 0.2])
    near, far = (packed(Surface(r.surface.vertices + at, r.surface.faces), r.material)[0] for at in (0, away))
    for name in ("low", "high"):
        np.testing.assert_allclose(np.array(far[name], np.float32), near[name], atol=1e-6 * RADIUS)
    np.testing.assert_allclose(np.array(far["centre"]) - near["centre"], away)


def test_lobes_may_have_another_colour_at_every_place(scene: SphereScene) -> None:
    """Red on one half, blue on the other: no purple."""
    surface, weight = scene.reconstruction.surface, scene.reconstruction.material.specular_weight.mean(2, keepdims=True)
    colour = np.where(surface.vertices[:, :1, None] > 0, [1.5, 0.6, 0.9], [0.3, 0.6, 2.1])
    material = replace(scene.reconstruction.material, specular_weight=weight * colour)
    about, packed_bytes = packed(surface, material)
    data, V = np.frombuffer(zlib.decompress(packed_bytes), np.uint8), len(surface.vertices)
    grey = (data[15 * V : 19 * V].reshape(V, 4) / 255) ** 2 * about["lobe_white"]
    hue = (data[19 * V : 22 * V].reshape(V, 1, 3) / 255) ** 2 * about["hue_white"]
    shown = grey[:, :2, None] * np.array(about["tint"])[:2] * hue
    np.testing.assert_allclose(shown, material.specular_weight, atol=0.02 * float(weight.max()))


def test_only_the_strongest_lobes_of_an_edited_material(scene: SphereScene) -> None:
    material = scene.reconstruction.material
    many = np.concatenate([material.specular_weight] * 3, axis=1) * np.array([1, 2, 3, 0.1, 5, 0.2])[:, None]
    about, _ = packed(scene.reconstruction.surface, replace(material, specular_weight=many, sharpness=np.arange(1.0, 7)))
    assert about["sharpness"] == [1, 2, 3, 5]


def test_a_model_without_room_has_fewer_faces_and_says_so() -> None:
    r = make_sphere(5, coloured_lobes=True).reconstruction
    whole = viewer_html(r.surface, r.material, UP, FROM)
    room = len(whole) - 100_000
    html = viewer_html(r.surface, r.material, UP, FROM, room=room)
    about = json.loads(re.search(r'id="viewer-about">(.*?)</script>', html)[1])  # type: ignore[index]
    # Of what there is room for most is used, and the model is that large still.
    assert room / 2 < len(html) <= room and about["faces"] < len(r.surface.faces)
    assert f"room for {about['faces']:,} of the model's {len(r.surface.faces):,} faces; model.glb" in html and "faces; model" not in whole
    np.testing.assert_allclose(np.array([about["low"], about["high"]]), [[-RADIUS] * 3, [RADIUS] * 3], rtol=0.02)


def test_fewer_vertices_have_the_material_of_their_place() -> None:
    r = make_sphere(4).reconstruction
    material = replace(r.material, confidence=(r.surface.vertices[:, 2] / RADIUS + 1) / 2)
    fewer = decimated(r.surface, 1000)
    assert fewer is not None
    carried = carried_over(r.surface, material, fewer.vertices)
    np.testing.assert_allclose(carried.confidence, (fewer.vertices[:, 2] / RADIUS + 1) / 2, atol=0.01)
    outward = normalise(fewer.vertices)
    expected = normalise(outward + 0.1 * np.sin(fewer.vertices[:, [1, 2, 0]] / 8))
    np.testing.assert_allclose(carried.normal, expected, atol=0.02)
    away = np.abs(fewer.vertices[:, 0]) > 5
    np.testing.assert_allclose(carried.albedo[away], colours(fewer.vertices)[away])


def test_no_room_for_any_model(scene: SphereScene) -> None:
    html = viewer_html(scene.reconstruction.surface, scene.reconstruction.material, UP, FROM, room=1000)
    assert "too large" in html and "<script" not in html


@pytest.fixture(scope="module")
def address(scene: SphereScene) -> Iterator[str]:
    white = np.ones((16, 32, 3), np.float32)
    red = replace(scene.reconstruction.material, albedo=np.tile([0.5, 0, 0], (len(scene.reconstruction.surface.vertices), 1)))
    with server(Model(scene.reconstruction, scene.capture, {"white.hdr": white}, {"red.json": red}), 0) as serving:
        threading.Thread(target=serving.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{serving.server_port}"
        serving.shutdown()


def test_the_server_shows_the_page_and_photographs(address: str, scene: SphereScene) -> None:
    page = urlopen(f"{address}/").read().decode()
    assert '"served": true' in page and "view_02, light 3" in page
    assert urlopen(f"{address}/photograph?of=view_02/3").read()[:2] == b"\xff\xd8"
    # The page's cameras are the photographs'.
    told = json.JSONDecoder().raw_decode(page, page.index("cameras = ") + len("cameras = "))[0]["view_02"]
    camera = scene.capture.views[1].camera
    np.testing.assert_allclose(told["eye"], camera.centre)
    np.testing.assert_allclose([told["forward"], told["above"]], [camera.rotation[2], -camera.rotation[1]])
    assert told["focal"] + told["middle"] == [*camera.K.diagonal()[:2], *camera.K[:2, 2]] and told["size"] == [camera.width, camera.height]


def test_the_server_traces_shadows(address: str, scene: SphereScene) -> None:
    seen = np.frombuffer(urlopen(f"{address}/shadow?light=0,0,1").read(), np.uint8)
    assert len(seen) == len(scene.reconstruction.surface.vertices) and set(seen.tolist()) <= {0, 255}
    assert (seen[scene.reconstruction.surface.vertices[:, 2] > 5] == 255).all()


def test_the_server_traces_environments(address: str, scene: SphereScene) -> None:
    """A white one makes every vertex of a convex body as bright as its albedo; a turned one shines from elsewhere."""
    surface = scene.reconstruction.surface

    def asked(words: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        answer = urlopen(f"{address}/environment?of={words}").read()
        numbers = np.frombuffer(answer[: -4 * len(surface.vertices)], "<f4").reshape(-1, 7)
        bits = np.frombuffer(answer[-4 * len(surface.vertices) :], "<u4")
        return numbers[:, :3], numbers[:, 3:6], (bits[:, None] >> np.arange(len(numbers))) & 1

    direction, colour, reached = asked("white.hdr")
    arriving = (np.maximum(scene.reconstruction.material.normal @ direction.T, 0) * reached) @ colour
    assert len(direction) == 32 and np.abs(arriving - 1).max() < 0.1
    first, turned = asked("window")[0], asked("window&turn=90")[0]
    # About the world's z, as in pictures, whatever is upwards in the first photograph.
    assert abs(scene.capture.views[0].camera.rotation[1, 2]) < 0.999
    assert np.allclose(first[:, 2], turned[:, 2], atol=1e-5) and np.abs(first - turned).max() > 0.5


def test_an_environment_is_cut_into_lights_once(scene: SphereScene, monkeypatch: pytest.MonkeyPatch) -> None:
    cut: list[float] = []

    def counted(picture: np.ndarray, *rest: Any) -> Illumination:
        cut.append(float(picture.mean()))
        return environment_lights(picture, *rest)

    monkeypatch.setattr("mvps.viewer.picture.environment_lights", counted)
    grey, dim = (np.full((16, 32, 3), level, np.float32) for level in (0.5, 0.25))
    model = Model(scene.reconstruction, None, {"grey.hdr": grey, "dim.hdr": dim})
    for query in ("of=grey.hdr", "of=grey.hdr&turn=30", "of=dim.hdr&turn=30", "of=grey.hdr&turn=-90"):
        model.environment(query)
    model.picture(urlencode({"scene": json.dumps(SCENE | {"environment": "grey.hdr", "turn": 60})}))
    assert cut == [0.5, 0.25]


SCENE: dict[str, Any] = {
    "eye": [60.0, 0, 0],
    "forward": [-1.0, 0, 0],
    "above": [0.0, 0, 1],
    "focal": [90.0, 90],
    "middle": [32.0, 24],
    "size": [64, 48],
    "layer": "image",
    "lights": [{"direction": [1.0, 1, 1], "colour": [1, 0.5, 0.25]}, {"direction": [0, 0, 2.0], "colour": [1, 1, 1]}],
    "fill": 0.0,
    "environment": "",
    "turn": 0,
    "material": "as solved",
    "exposure": 1.5,
}


def pictured(address: str, **changed: Any) -> np.ndarray:
    """(48, 64, 3) red, green, blue of the scene."""
    data = urlopen(f"{address}/picture?" + urlencode({"scene": json.dumps(SCENE | changed)})).read()
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)[..., ::-1].astype(float)


def test_the_server_traces_what_the_page_shows(address: str, scene: SphereScene) -> None:
    """The picture of mvps.render under the same camera and lights, before the page's grey."""
    r = scene.reconstruction
    camera = look_at(np.array([60.0, 0, 0]), np.zeros(3), np.array([0.0, 0, 1]), 64, 48, 2 * np.degrees(np.arctan(24 / 90)))
    directions = np.array([[1.0, 1, 1], [0, 0, 1]]) / np.array([[np.sqrt(3)], [1]])
    light = Illumination(directions, np.array([[1, 0.5, 0.25], [1, 1, 1]]))
    found, coverage = rendered(RayCaster(r.surface), r.material, camera, light, ["image"])
    image = pictured(address)
    inside, outside = coverage == 1, coverage == 0
    assert inside.sum() > 200 and (image[outside] == 33).all()
    np.testing.assert_allclose(image[inside], srgb_bytes(1.5 * found["image"])[inside], atol=1.01)


def test_a_lamp_at_the_eye_and_an_environment_add_light(address: str) -> None:
    bare = pictured(address)
    filled, around = pictured(address, fill=0.5), pictured(address, environment="white.hdr")
    assert (filled >= bare).all() and filled.mean() > bare.mean() + 2
    assert (around >= bare - 1).all() and around.mean() > bare.mean() + 2
    assert np.abs(pictured(address, layer="specular") - bare).mean() > 2


def test_the_server_has_other_materials(address: str, scene: SphereScene) -> None:
    """The page starts with the edited one; all are on the same vertices."""
    page = urlopen(f"{address}/").read().decode()
    assert re.search(r'id="viewer-material"><option>red.json</option><option>as solved</option><option>matte</option>', page)
    surface = scene.reconstruction.surface

    def albedo(name: str) -> np.ndarray:
        answer = json.loads(urlopen(f"{address}/material?{urlencode({'of': name})}").read())
        V = answer["about"]["vertices"]
        assert len(surface.vertices) == V
        return np.frombuffer(zlib.decompress(base64.b64decode(answer["data"])), np.uint8)[12 * V : 15 * V].reshape(V, 3)

    assert not albedo("red.json")[:, 1:].any() and not albedo("gold").any() and albedo("as solved").all()
    red = pictured(address, material="red.json")
    assert red[20:28, 28:36, 0].min() > 10 * red[20:28, 28:36, 1].mean() / 9
    assert (pictured(address) - red)[..., 1].mean() > 2


def test_the_layer_of_shadows_is_that_of_mvps_render(address: str, scene: SphereScene) -> None:
    """White where another part hides the light, which none of a ball does."""
    image = pictured(address, layer="shadow", fill=0.5, environment="white.hdr", eye=[400.0, 0, 0])
    assert (image[24, 32] == 0).all() and (image[0, 0] == 33).all()


def test_files_of_one_name_stay_apart() -> None:
    found = named([Path("a/x.hdr"), Path("b/x.hdr"), Path("c/studio"), Path("y.hdr")], ["studio"])
    assert list(found) == ["a/x.hdr", "b/x.hdr", "c/studio", "y.hdr"]


def test_a_page_that_is_closed_is_no_error(address: str, capfd: pytest.CaptureFixture[str]) -> None:
    host, port = address.removeprefix("http://").split(":")
    for _ in range(3):
        left = socket.create_connection((host, int(port)))
        left.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        left.sendall(b"GET / HTTP/1.1\r\n\r\n")
        left.close()
    urlopen(f"{address}/").read()
    time.sleep(0.5)
    assert capfd.readouterr().err == ""


@pytest.mark.usefixtures("interruptible")
def test_ctrl_c_ends_it(scene: SphereScene, tmp_path: Path) -> None:
    write_reconstruction(scene.reconstruction, tmp_path / "result")
    command = [sys.executable, "-m", "mvps.view", str(tmp_path / "result"), "--port", "0", "--no-browser"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as running:
        assert running.stdout is not None
        assert "http://127.0.0.1:" in running.stdout.readline()
        running.send_signal(signal.SIGINT)
        try:
            _, said = running.communicate(timeout=60)
        finally:
            running.kill()
    assert (running.returncode, said) == (0, "")


@pytest.mark.parametrize(
    "changed",
    [
        {"eye": [0, 0]},
        {"eye": [float("nan"), 0, 0]},
        {"forward": [0, 0, 0]},
        {"above": [1, 0, 0]},
        {"size": [64, 100000]},
        {"size": 3},
        {"focal": [0, 0]},
        {"layer": "secrets"},
        {"lights": [{"direction": [0, 0, 0], "colour": [1, 1, 1]}]},
        {"lights": [{"direction": [0, 0, 1]}]},
        {"fill": -1},
        {"exposure": float("inf")},
        {"environment": "nowhere"},
        {"turn": "x"},
        {"material": "cheese"},
    ],
)
def test_no_scene_is_refused(address: str, changed: dict[str, Any]) -> None:
    with pytest.raises(HTTPError) as refused:
        pictured(address, **changed)
    assert refused.value.code == 400


@pytest.mark.parametrize("name", MADE)
def test_environments_without_a_file(name: str) -> None:
    """Not negative, and of mean radiance 1 over the sphere."""
    picture = made(name)
    lights = environment_lights(picture, 4096, UP)
    assert picture.min() >= 0 and abs(lights.intensity.mean(1).sum() - 4) < 0.01


@pytest.mark.parametrize(
    ("path", "code"),
    [
        ("/environment?of=nowhere", 400),
        ("/environment?of=window&turn=x", 400),
        (f"/environment?of=window&turn={'9' * 5000}", 400),
        ("/material?of=cheese", 400),
        ("/picture", 400),
        ("/picture?scene=[1,2]", 400),
        ("/shadow?light=0,0,0", 400),
        ("/shadow?light=x", 400),
        ("/shadow", 400),
        ("/photograph?of=view_77/1", 400),
        (f"/photograph?of=view_01/{'9' * 5000}", 400),
        ("/../etc/passwd", 404),
    ],
)
def test_other_questions_are_refused(address: str, path: str, code: int) -> None:
    with pytest.raises(HTTPError) as refused:
        urlopen(f"{address}{path}")
    assert refused.value.code == code


def test_a_taken_port_is_named(address: str, scene: SphereScene, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_reconstruction(scene.reconstruction, tmp_path / "result")
    port = address.rpartition(":")[2]
    assert run(main, [str(tmp_path / "result"), "--port", port, "--no-browser"]) == 2
    assert f"--port {port}: wanted a free one" in capsys.readouterr().err
    assert run(main, [str(tmp_path / "nothing"), "--no-browser"]) == 2
