"""The page: a heading with the outcome, then one section for each thing that the reconstruction knows about itself."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from mvps.camera import DILIGENT_FROM_CAMERA
from mvps.cores import on_cores
from mvps.folders import write_whole
from mvps.rendering import light_senders
from mvps.report.charts import light_sphere, line_chart, pair_chart
from mvps.report.pictures import data_address, view_pictures
from mvps.report.words import NOT_TRIED, captured, is_number, reason, without_held_out
from mvps.scene import Capture, Reconstruction, View
from mvps.viewer import STYLE as VIEWER_STYLE
from mvps.viewer import viewer_html
from mvps.visibility import ray_caster

VIEWS_SHOWN = 4

LONG = 20
"""Letters of a cell that stand on several lines."""

LARGEST_BYTES = 15_000_000
"""Of a page, so that it can be sent on: the model gets what its pictures and tables leave."""

ENLARGE = """
for(const button of document.querySelectorAll(".enlarge"))button.addEventListener("click",()=>{
const large=button.parentElement.classList.toggle("large");button.setAttribute("aria-expanded",large);
if(large)button.scrollIntoView({block:"nearest"})})
"""
"""A picture that is clicked takes the page's whole width, or its place again."""

STYLE = """
:root{color-scheme:light dark;--ink:#1c1c1c;--paper:#fff;--line:#d0d0d0;--soft:#f3f3f1;--mark:#b4501e}
@media(prefers-color-scheme:dark){:root{--ink:#e8e8e8;--paper:#161616;--line:#444;--soft:#222;--mark:#f0904f}}
body{font:16px/1.5 system-ui,sans-serif;color:var(--ink);background:var(--paper);margin:0 auto;max-width:72rem;padding:1rem}
h1{margin:.2em 0}h2{margin:2em 0 .5em;border-bottom:1px solid var(--line)}
.status{padding:.7em 1em;background:var(--soft);border-left:4px solid var(--mark)}
.grid{display:grid;grid-template-columns:repeat(auto-fill,minmax(max(8rem,22%),1fr));gap:.6rem}
.grid .large{grid-column:1/-1}
.enlarge{display:block;width:100%;padding:0;border:0;background:none;cursor:zoom-in}.large .enlarge{cursor:zoom-out}
figure{margin:0}figure img{width:100%;height:auto;display:block}.grid .large img{height:90vh;object-fit:contain}figcaption{font-size:.85rem}
.spheres{grid-template-columns:repeat(auto-fill,minmax(12rem,1fr))}.sphere{max-width:20rem}
code{white-space:nowrap}
.facts{display:grid;grid-template-columns:fit-content(40%) 1fr;gap:.25rem 1.2rem;margin:0}.facts dt{font-weight:600}.facts dd{margin:0}
.wide{overflow-x:auto}table{border-collapse:collapse;min-width:min(100%,24rem)}
th,td{text-align:left;padding:.25em .8em .25em 0;border-bottom:1px solid var(--line);vertical-align:top}
.number{text-align:right;font-variant-numeric:tabular-nums}.words{min-width:8rem}
.bar{display:inline-block;height:.7em;background:var(--mark)}
svg{width:100%;max-width:30rem;height:auto;font-size:12px}svg text{fill:currentColor}
.axis{fill:none;stroke:var(--line)}.ring{fill:none;stroke:#888}.ring:first-child{fill:#333}.line{fill:none;stroke:var(--mark);stroke-width:2}.dots{fill:var(--mark)}
.light{stroke:#aaa;stroke-width:1}
pre{background:var(--soft);padding:.8em;overflow-x:auto;font-size:.85rem}
"""


CALIBRATION = ("confidence_stated_", "confidence_measured_")
"""Beginnings of the measures that the chart of confidence shows."""


def write_report(reconstruction: Reconstruction, capture: Capture, path: Path) -> None:
    """Write the page of a reconstruction and the capture it was made from (or part of it) to `path`, whole or not at all."""
    write_whole(path, report_html(reconstruction, capture))


def report_html(reconstruction: Reconstruction, capture: Capture) -> str:
    """The page as text. Views and lights of the capture that the reconstruction does not hold are left out of the pictures."""
    metrics = reconstruction.metrics
    heading = _heading(reconstruction, capture)
    sections = [
        _captured(reconstruction, capture),
        _findings(metrics.get("findings") or []),
        _signs(metrics.get("status") or {}, metrics.get("held_out") or {}),
        _pictures(reconstruction, capture),
        _lights(reconstruction, capture),
        _rounds(metrics.get("rounds") or []),
        _components((metrics.get("model") or {}).get("components") or []),
        _truth(metrics.get("truth") or {}),
        _stages(metrics.get("stages") or []),
        _settings(reconstruction.settings),
    ]
    room = LARGEST_BYTES - len(_page(capture.name, [heading, *sections]).encode())
    return _page(capture.name, [heading, _viewer(reconstruction, capture, room), *sections])


def _page(name: str, sections: Sequence[str]) -> str:
    title = escape(f"Reconstruction of {name}")
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{title}</title><style>{STYLE}{VIEWER_STYLE}</style></head>\n<body>\n<main>\n"
        + "\n".join(filter(None, sections))
        + f"\n</main>\n<script>{ENLARGE}</script>\n</body></html>\n"
    )


def _section(title: str, content: str) -> str:
    return f"<section><h2>{escape(title)}</h2>\n{content}</section>"


def _shown(value: Any) -> str:
    """A value as text: four digits for a number, words for yes, no and nothing."""
    if isinstance(value, bool) or value is None:
        return {True: "yes", False: "no", None: "-"}[value]
    if isinstance(value, float):
        return f"{value:.4g}"
    return value if isinstance(value, str) else json.dumps(value)


def _table(head: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """A table; numbers stand to the right, and sentences have room on a phone. All cells but _Html are escaped."""
    kinds = [_kind([row[k] for row in rows]) for k in range(len(head))]

    def cells(tag: str, values: Sequence[Any]) -> str:
        texts = [value.html if isinstance(value, _Html) else escape(_shown(value)) for value in values]
        return "<tr>" + "".join(f"<{tag}{kind}>{text}</{tag}>" for kind, text in zip(kinds, texts, strict=True)) + "</tr>"

    body = "".join(cells("td", row) for row in rows)
    return f'<div class="wide"><table><thead>{cells("th", head)}</thead><tbody>{body}</tbody></table></div>'


def _kind(column: Sequence[Any]) -> str:
    if any(is_number(value) for value in column):
        return ' class="number"'
    return ' class="words"' if any(isinstance(value, str) and len(value) > LONG for value in column) else ""


class _Html:
    """Text that is HTML already."""

    def __init__(self, html: str) -> None:
        self.html = html


def _columns(records: Sequence[Mapping[str, Any]], names: Mapping[str, str]) -> str:
    """A table of records with the columns (key: title) that at least one of them has."""
    kept = {key: title for key, title in names.items() if any(key in record for record in records)}
    return _table(list(kept.values()), [[record.get(key, "") for key in kept] for record in records])


def _heading(reconstruction: Reconstruction, capture: Capture) -> str:
    surface, metrics = reconstruction.surface, reconstruction.metrics
    photographs = sum(map(len, reconstruction.light_names))
    facts = [
        f"{len(surface.vertices):,} vertices and {len(surface.faces):,} faces from {len(reconstruction.views):,} views with"
        f" {photographs:,} photographs."
    ]
    seconds = [stage["seconds"] for stage in metrics.get("stages") or [] if is_number(stage.get("seconds"))]
    if seconds:
        facts.append(f"{sum(seconds):.1f} s in all.")
    status = metrics.get("status") or {}
    words = ": ".join(str(status[key]) for key in ("name", "text") if status.get(key))
    outcome = f'<p class="status">{escape(words)}</p>' if words else ""
    return f"<h1>{escape(capture.name)}</h1>\n<p>{escape(' '.join(facts))}</p>\n{outcome}"


def _viewer(reconstruction: Reconstruction, capture: Capture, room: int) -> str:
    """The model to turn and to light, as the first known view's camera sees it, in `room` bytes."""
    views = _known_views(reconstruction, capture)
    if not views:
        return ""
    rotation = views[0].camera.rotation
    return _section("Model", viewer_html(reconstruction.surface, reconstruction.material, -rotation[1], -rotation[2], room=room))


def _captured(reconstruction: Reconstruction, capture: Capture) -> str:
    facts = captured(reconstruction, [view for view in capture.views if view.name in reconstruction.views])
    rows = "".join(f"<dt>{escape(name)}</dt><dd>{escape(words)}</dd>" for name, words in facts)
    return _section("Capture", f'<dl class="facts">{rows}</dl><p>Units of length are those of the capture\'s cameras.</p>')


def _findings(findings: Sequence[Mapping[str, Any]]) -> str:
    """What was wrong with the capture."""
    names = {"where": "where", "about": "what", "text": "finding", "mended": "mended"}
    return _section("Found in the capture", _columns(findings, names)) if findings else ""


SIGNS = {
    "expected_deg": ("normals: expected error, mean", 1.0, "deg"),
    "depth_px": ("depth of what one view alone sees: expected error, mean over the surface", 1.0, "px"),
    "views_deg": ("normals of different views at the same place: standard deviation", 1.0, "deg"),
    "photographs": ("photographs that show a place: median over the surface", 1.0, ""),
    "outline_px": ("outlines against the masks: distance, mean", 1.0, "px"),
    "misfit": ("photographs against the model, without noise: share of the signal", 100.0, "%"),
    "noise": ("noise of the photographs: share of the signal", 100.0, "%"),
}
"""Of the verdict (mvps.verdict): what, factor, unit."""


HELD_OUT = {
    "held_out_views_psnr_db": "photographs of views that were held back, against the model: mean PSNR inside the mask",
    "held_out_lights_psnr_db": "photographs under lights that were held back, against the model: mean PSNR inside the mask",
}
"""Of the held-out photographs (mvps.measures.images)."""


def _signs(status: Mapping[str, Any], held_out: Mapping[str, Any]) -> str:
    """By what the result was judged, without knowing the truth, and what photographs that were held back say of it."""
    rows = [(what, factor * status[key], unit) for key, (what, factor, unit) in SIGNS.items() if is_number(status.get(key))]
    rows += [(what, held_out[key], "dB") for key, what in HELD_OUT.items() if is_number(held_out.get(key))]
    # Options stay in one piece where lines break.
    instead = re.sub("(--[a-z-]+)", r"<code>\1</code>", escape(without_held_out(status)))
    return _section("How good", _table(["sign", "value", "unit"], rows) + ("" if held_out else f"<p>{instead}</p>")) if rows else ""


def _known_views(reconstruction: Reconstruction, capture: Capture) -> list[View]:
    """Up to VIEWS_SHOWN views, spread, of which both the capture and the result hold a photograph."""
    numbers = dict(zip(reconstruction.views, reconstruction.light_names, strict=True))
    known = [v for v in capture.views if len(v.pixels) and set(v.lights) & set(numbers.get(v.name, ()))]
    shown = min(len(known), VIEWS_SHOWN)
    return [known[k * len(known) // shown] for k in range(shown)]


def _pictures(reconstruction: Reconstruction, capture: Capture) -> str:
    views = _known_views(reconstruction, capture)
    if not views:
        return ""
    caster, senders = ray_caster(reconstruction.surface), light_senders(reconstruction.surface, reconstruction.material)
    parts = []
    shown = on_cores(lambda view: view_pictures(caster, senders, reconstruction, view), views)
    for view, (light, pictures) in zip(views, shown, strict=True):
        figures = "".join(
            '<figure><button type="button" class="enlarge" aria-expanded="false" title="larger or smaller">'
            f'<img src="{data_address(p.image)}" width="{p.image.shape[1]}" height="{p.image.shape[0]}"'
            f' alt="{escape(p.text)}"></button><figcaption>{escape(p.title)}</figcaption></figure>'
            for p in pictures
        )
        parts.append(f'<h3>{escape(view.name)}, {escape(light)}</h3><div class="grid">{figures}</div>')
    return _section("Views", "\n".join(parts))


def _lights(reconstruction: Reconstruction, capture: Capture) -> str:
    """One sphere for a rig that stands still with the camera, one for each view shown otherwise; in the camera's frame with y up."""
    alike = reconstruction.lights.one_rig and not reconstruction.lights.fixed
    views = _known_views(reconstruction, capture)[: 1 if alike else VIEWS_SHOWN]
    spheres = []
    for view in views:
        place = reconstruction.views.index(view.name)
        local = reconstruction.lights.direction[place] @ view.camera.rotation.T @ DILIGENT_FROM_CAMERA
        name = "all views" if alike else view.name
        spheres.append(light_sphere(local, reconstruction.lights.intensity[place], reconstruction.light_names[place], name))
    if not spheres:
        return ""
    words = "<p>As the camera sees them; rings at 30, 60 and 90 degrees, areas are intensities, hollow ones are behind the object.</p>"
    return _section("Lights", words + f'<div class="grid spheres">{"".join(spheres)}</div>')


ROUND_COLUMNS = {
    "round": "round",
    "residual": "residual",
    "light_change_deg": "lights moved, deg",
    "normal_change_deg": "normals moved, deg",
    "vertex_change_px": "vertices moved, px",
}


def _rounds(rounds: Sequence[Mapping[str, Any]]) -> str:
    if not rounds:
        return ""
    # Every stage counts its own from one.
    counted = [{**one, "round": k} for k, one in enumerate(rounds, 1)]
    residuals = [one["residual"] if is_number(one.get("residual")) else None for one in rounds]
    names = [str(one["round"]) for one in counted]
    chart = line_chart(residuals, names, "round", "residual") if any(value is not None for value in residuals) else ""
    return _section("Rounds", chart + _columns(counted, ROUND_COLUMNS))


def _components(components: Sequence[Mapping[str, Any]]) -> str:
    if not components:
        return ""
    rows = [{**c, "name": str(c.get("name", "")).partition(NOT_TRIED)[0], "why": reason(c)} for c in components]
    names = {"name": "component", "kept": "kept", "why": "why", "seconds": "time, s"}
    said = (
        "<p>While the model is chosen, some lights of every view are kept back. A component stays if it lowers the error on them by more"
        " than three standard errors; inter-reflection, which needs no proof, unless samples in shadow speak against it by as much.</p>"
    )
    return _section("Reflectance model", said + _columns(rows, names))


def _truth(truth: Mapping[str, Any]) -> str:
    rows = [(key.replace("_", " "), value) for key, value in truth.items() if not key.startswith(CALIBRATION)]
    stated, measured = ([value for key, value in truth.items() if key.startswith(part)] for part in CALIBRATION)
    pairs = [(a, b) for a, b in zip(stated, measured, strict=True) if a > 0 and b > 0]
    chart = f"<h3>Error of normals, deg: stated and measured</h3>{pair_chart(pairs, 'stated', 'measured')}" if pairs else ""
    return _section("Against ground truth", _table(["measure", "value"], rows) + chart) if rows else ""


def _stages(stages: Sequence[Mapping[str, Any]]) -> str:
    if not stages:
        return ""
    longest = max((s["seconds"] for s in stages if is_number(s.get("seconds"))), default=0) or 1
    shown = [
        {**s, "bar": _Html(f'<span class="bar" style="width:{6 * s["seconds"] / longest:.2f}rem"></span>')}
        if is_number(s.get("seconds"))
        else s
        for s in stages
    ]
    names = {"name": "stage", "seconds": "time, s", "bar": "", "peak_memory_mb": "peak memory so far, MB", "status": "outcome"}
    return _section("Time and memory", _columns(shown, names))


def _settings(settings: Mapping[str, Any]) -> str:
    text = json.dumps(settings, indent=1, sort_keys=True, ensure_ascii=False)
    return (
        _section("Settings", f"<details><summary>all options and versions</summary><pre>{escape(text)}</pre></details>") if settings else ""
    )
