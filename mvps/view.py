"""python -m mvps.view RESULT: a page in the browser with the model, to turn and to light, with exact shadows.

The page is the viewer of viewer/ served from this machine alone; for every light that the mouse asks for, Embree traces which vertices it
reaches, and so for the lights that stand for an environment: one of viewer/environments.py, or a file (--envmap). The material is the
solved one, an edited one (--edit) or a preset (edits.py). Once all is at rest it is traced ray by ray, with inter-reflection
(viewer/picture.py). With --capture the photographs stand beside: one is chosen, and the model takes its camera and its light.
"""

from __future__ import annotations

import base64
import json
import signal
import sys
from argparse import SUPPRESS
from collections.abc import Callable, Mapping, Sequence
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qs, urlsplit

from mvps.command import parse, parser, run
from mvps.render import UP, direction
from mvps.scene import CaptureError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from mvps.scene import Bool, Capture, Float, Material, Reconstruction

Answer = tuple[str, bytes]
"""A type of content, and the content."""

SOLVED = "as solved"

LONGEST = 9
"""Digits of a number in an address."""


class Model:
    """What the server knows: the page, shadows, environments, materials, photographs."""

    def __init__(
        self,
        result: Reconstruction,
        capture: Capture | None,
        environments: Mapping[str, NDArray[np.float32]] = MappingProxyType({}),
        materials: Mapping[str, Material] = MappingProxyType({}),
        sky: Sequence[float] = UP,
    ) -> None:
        """environments: pictures (height, width, 3) by names, beside those of viewer/environments.py; materials: edited ones by names,
        beside the solved one and the presets of edits.py; the page starts with the first. sky (3,): upwards in environments, world frame;
        the object is turned about the first camera's upwards direction."""
        import numpy as np

        from mvps.edits import PRESETS
        from mvps.viewer.environments import MADE, made
        from mvps.visibility import ray_caster

        self._result = result
        self._caster = ray_caster(result.surface)
        self._views = {} if capture is None else {view.name: view for view in capture.views if view.name in result.views}
        self._environments = {name: made(name) for name in MADE} | dict(environments)
        self._materials: dict[str, Material | None] = {**materials, SOLVED: result.material, **dict.fromkeys(PRESETS)}
        self._towards, self._up, self._sky = np.array([1.0, 0.0, 0.3]), np.array(UP), np.array(sky)
        if self._views:
            first = next(iter(self._views.values())).camera
            self._towards, self._up = -first.rotation[2], -first.rotation[1]

    def page(self, _: str) -> Answer:
        """The viewer, with a list of photographs where there is a capture."""
        from mvps.report.page import STYLE as PAGE_STYLE
        from mvps.viewer import STYLE, viewer_html

        names = tuple(self._materials)
        first = self._material(names[0])
        part = viewer_html(
            self._result.surface, first, self._up, self._towards, True, tuple(self._environments), names, exposed=self._result.material
        )
        beside = self._photographs()
        body = f'<div class="beside"><div>{part}</div><div>{beside}</div></div>' if beside else part
        head = (
            f'<head><meta charset="utf-8"><link rel="icon" href="data:,"><title>mvps.view</title><style>{PAGE_STYLE}{STYLE}</style></head>'
        )
        return "text/html; charset=utf-8", f'<!DOCTYPE html>\n<html lang="en">{head}<body>{body}</body></html>'.encode()

    def _material(self, name: str) -> Material:
        """CaptureError where there is none of that name."""
        from mvps.edits import edited

        if name not in self._materials:
            raise CaptureError(f"of: wanted one of {', '.join(self._materials)}, given {name!r}")
        found = self._materials[name]
        if found is None:
            found = self._materials[name] = edited(self._result.surface, self._result.material, [{"preset": name}], {})
        return found

    def _photographs(self) -> str:
        if not self._views:
            return ""
        result = self._result
        options, cameras = [], {}
        for name, view in self._views.items():
            place, camera = result.views.index(name), view.camera
            cameras[name] = {
                "eye": camera.centre.tolist(),
                "forward": camera.rotation[2].tolist(),
                "above": (-camera.rotation[1]).tolist(),
                "focal": [camera.K[0, 0], camera.K[1, 1]],
                "middle": [camera.K[0, 2], camera.K[1, 2]],
                "size": [camera.width, camera.height],
            }
            for number in view.lights:
                # What was left out is no data.
                if number not in result.light_names[place] or not view.shown[view.lights.index(number)]:
                    continue
                row = result.light_names[place].index(number)
                light = (*result.lights.direction[place][row], *result.lights.intensity[place][row])
                said = ",".join(f"{x:.6f}" for x in light)
                options.append(f'<option value="{name}/{number}|{said}">{name}, light {number}</option>')
        return (
            f'<p><label>Photograph <select id="photograph">{"".join(options)}</select></label></p>'
            '<img id="beside" alt="the photograph" style="width:100%">'
            f"<script>(() => {{ const list = document.getElementById('photograph'), cameras = {json.dumps(cameras)};"
            "const show = () => { const [name, said] = list.value.split('|');"
            "document.getElementById('beside').src = 'photograph?of=' + name;"
            "if (!window.mvpsViewer) return; window.mvpsViewer.look(cameras[name.split('/')[0]]);"
            "const light = said.split(',').map(Number); window.mvpsViewer.lightFrom(light.slice(0, 3), light.slice(3)); };"
            "list.addEventListener('input', show); window.addEventListener('mvpsviewer', show); show(); })();</script>"
        )

    def shadow(self, query: str) -> Answer:
        """A byte per vertex, 255 where the light of ?light=x,y,z reaches it. CaptureError where that is no direction."""
        import numpy as np

        try:
            light = np.array([float(word) for word in parse_qs(query)["light"][0].split(",")])
        except (KeyError, ValueError):
            light = np.zeros(0)
        if light.shape != (3,) or not np.isfinite(light).all() or not light.any():
            raise CaptureError(f"light: wanted three numbers, given {query!r}")
        return "application/octet-stream", np.where(self._hidden(light[None] / np.linalg.norm(light))[:, 0], 0, 255).astype("u1").tobytes()

    def _hidden(self, lights: Float) -> Bool:
        """(V, lights) whether the mesh hides a light from a vertex."""
        from mvps.visibility import shadows

        return shadows(self._caster, self._result.surface.vertices, self._caster.vertex_normals, lights)

    def environment(self, query: str) -> Answer:
        """Of ?of=studio&turn=30 the lights that stand for the environment, turned by so many degrees: float32 (lights, 7) direction, colour
        and spread (illumination.py); then uint32 (V,), of each vertex the bits of the lights that reach it. CaptureError where there is no
        such environment."""
        import numpy as np

        from mvps.viewer.picture import surroundings

        asked = parse_qs(query)
        name, turn = (asked.get("of") or [""])[0], (asked.get("turn") or ["0"])[0]
        if not turn.removeprefix("-").isdecimal() or len(turn) > LONGEST:
            raise CaptureError(f"turn: wanted whole degrees, given {query!r}")
        light = surroundings(self._environments, name, int(turn), self._sky)
        lights = np.column_stack([light.direction, light.intensity, light.spread]).astype("<f4")
        reached = ~self._hidden(light.direction) @ (1 << np.arange(len(lights), dtype=np.uint32))
        return "application/octet-stream", lights.tobytes() + reached.astype("<u4").tobytes()

    def material(self, query: str) -> Answer:
        """Of ?of=gold what the page must know of that material, and its arrays (viewer/__init__.py), as JSON. CaptureError where there is
        none."""
        from mvps.viewer import packed

        about, data = packed(self._result.surface, self._material((parse_qs(query).get("of") or [""])[0]))
        return "application/json", json.dumps({"about": about, "data": base64.b64encode(data).decode("ascii")}).encode()

    def picture(self, query: str) -> Answer:
        """The PNG of ?scene={...}, what the page shows (viewer/picture.py), ray by ray. CaptureError where that is no scene."""
        from mvps.illumination import Illumination
        from mvps.rendering import light_senders
        from mvps.texture import png_bytes
        from mvps.viewer.picture import asked, picture, surroundings

        scene = asked((parse_qs(query).get("scene") or [""])[0])
        around = surroundings(self._environments, scene.environment, scene.turn, self._sky) if scene.environment else Illumination()
        surface, material = self._result.surface, self._material(scene.material)
        shown = picture(self._caster, material, light_senders(surface, material), scene, around)
        return "image/png", png_bytes(shown)

    def photograph(self, query: str) -> Answer:
        """A photograph, ?of=view_04/7, as a JPEG for the screen. CaptureError where there is none."""
        import cv2
        import numpy as np

        from mvps.pbr import srgb_bytes

        name, _, number = (parse_qs(query).get("of") or [""])[0].partition("/")
        view = self._views.get(name)
        if view is None or not number.isdecimal() or len(number) > LONGEST or int(number) not in view.lights:
            raise CaptureError(f"of: wanted a photograph such as {next(iter(self._views), 'view_01')}/1, given {query!r}")
        image = np.zeros((*view.mask.shape, 3))
        image[view.mask] = view.radiance([view.lights.index(int(number))])[:, 0]
        shown = srgb_bytes(image / max(float(np.quantile(image[view.mask], 0.99)), 1e-12))
        return "image/jpeg", cv2.imencode(".jpg", np.ascontiguousarray(shown[..., ::-1]))[1].tobytes()


class _Server(ThreadingHTTPServer):
    def handle_error(self, request: Any, client_address: Any) -> None:
        """A page that is closed or loaded anew no longer waits for its answers, which is no error."""
        if not isinstance(sys.exception(), ConnectionError):
            super().handle_error(request, client_address)


def server(model: Model, port: int) -> ThreadingHTTPServer:
    """A server of the model on this machine's own address; port 0: any free one. OSError where the port is taken."""
    pages: dict[str, Callable[[str], Answer]] = {
        "/": model.page,
        "/shadow": model.shadow,
        "/environment": model.environment,
        "/material": model.material,
        "/picture": model.picture,
        "/photograph": model.photograph,
    }

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            address = urlsplit(self.path)
            if address.path not in pages:
                self.send_error(404)
                return
            try:
                kind, content = pages[address.path](address.query)
            except CaptureError as error:
                self.send_error(400, str(error)[:200].encode("ascii", "replace").decode())
                return
            self.send_response(200)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            self.wfile.write(content)

        def log_message(self, format: str, *values: object) -> None:
            """Nothing: every move of the mouse asks for something."""

    return _Server(("127.0.0.1", port), Handler)


def named(paths: Sequence[Path], taken: Sequence[str] = ()) -> dict[str, Path]:
    """The paths by their last parts, those that would be alike, or like one that is taken, by all of them."""
    last = [path.name for path in paths]
    return {name if last.count(name) == 1 and name not in taken else str(path): path for name, path in zip(last, paths, strict=True)}


def main(argv: Sequence[str]) -> None:
    """The command line."""
    made = parser("mvps.view", "Show a result in the browser: turn the model, move the light, with exact shadows. Ends with Ctrl-C.")
    made.add_argument("result", type=Path, metavar="RESULT", help="folder that mvps.reconstruct wrote")
    made.add_argument("--capture", type=Path, default=SUPPRESS, metavar="CAPTURE", help="folder of the photographs, to stand beside")
    made.add_argument(
        "--edit", type=Path, action="append", default=[], metavar="FILE", help="an edited material (docs/edits.md); may be repeated"
    )
    made.add_argument(
        "--envmap", type=Path, action="append", default=[], metavar="FILE", help="an environment to choose, .hdr or .exr; may be repeated"
    )
    made.add_argument("--up", type=direction, default=UP, metavar="X,Y,Z", help="upwards in environments, world frame")
    made.add_argument("--port", type=int, default=8080, help="of the page's address; 0: any free one")
    made.add_argument("--no-browser", action="store_true", help="print the address only")
    given = parse(made, argv)
    if not 0 <= given.port < 65536:
        raise CaptureError(f"--port: wanted a number from 0 to 65535, given {given.port}")
    import webbrowser

    from mvps.edits import PRESETS, edited, read_edits
    from mvps.export import read_reconstruction
    from mvps.load import read_environment
    from mvps.same_object import capture_of, photographs_in
    from mvps.viewer.environments import MADE

    result = read_reconstruction(given.result)
    capture = capture_of(result, given.capture, *photographs_in(result, given.capture)) if "capture" in given else None
    cameras = {} if capture is None else {view.name: view.camera for view in capture.views}
    materials = {
        name: edited(result.surface, result.material, read_edits(path), cameras)
        for name, path in named(given.edit, [SOLVED, *PRESETS]).items()
    }
    environments = {name: read_environment(path) for name, path in named(given.envmap, list(MADE)).items()}
    model = Model(result, capture, environments, materials, given.up)
    try:
        serving = server(model, given.port)
    except OSError as error:
        raise CaptureError(f"--port {given.port}: wanted a free one, given {error.strerror}; choose another --port") from error
    with serving:
        address = f"http://127.0.0.1:{serving.server_port}/"
        try:
            print(f"{address}  (Ctrl-C ends)", flush=True)
            if not given.no_browser:
                webbrowser.open(address)
            serving.serve_forever()
        except KeyboardInterrupt as ended:
            # Ctrl-C is how it ends; other signals are not.
            if ended.args not in ((), (signal.SIGINT,)):
                raise


if __name__ == "__main__":
    raise SystemExit(run(main))
