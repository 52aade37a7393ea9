"""The figures that papers printed: the file is whole, and says what the papers say."""

from __future__ import annotations

from collections import Counter, defaultdict

import pytest

from mvps.evaluate import PROTOCOLS, ROWS
from mvps.published import AVERAGE, DILIGENT_MV, DILIGENT_OBJECTS, diligent_object, figures, published


def test_every_line_is_a_figure() -> None:
    found = figures()
    assert len(found) > 600
    for f in found:
        assert f.data and f.object and f.method and f.metric and f.unit and f.source
        assert "\\" not in f.method and f.value >= 0
        assert f.protocol in {*PROTOCOLS, "other", "time"} - {"ours"}
    counts = Counter((f.data, f.object, f.method, f.key, f.source) for f in found)
    assert max(counts.values()) == 1
    assert {f.object for f in found if f.data == DILIGENT_MV} == {*DILIGENT_OBJECTS, AVERAGE, "one"}


def test_figures_are_named_as_evaluate_names_them() -> None:
    known = {key for rows in ROWS.values() for row in rows for key in row.keys}
    there = {f.key for f in figures() if f.protocol in PROTOCOLS}
    # One table of PS-NeRF's has normals inside the true mask, which a result need not fill.
    assert there - known == {"psnerf_normal_error_truth_mask_deg"}


def test_averages_are_those_of_the_objects() -> None:
    groups = defaultdict(dict)
    for f in figures():
        if f.data in (DILIGENT_MV, "DiLiGenT-MV and Synth-PS"):
            groups[f.method, f.metric, f.source][f.object] = f
    compared = 0
    for group in groups.values():
        objects = [f.value for name, f in group.items() if name in DILIGENT_OBJECTS]
        if AVERAGE in group and len(objects) == 5 and group[AVERAGE].data == DILIGENT_MV:
            digits = 2 if group[AVERAGE].metric != "ssim" else 4
            # Both are rounded.
            assert abs(sum(objects) / 5 - group[AVERAGE].value) <= 1.01 * 10**-digits, group[AVERAGE]
            compared += 1
    assert compared == 13


def test_the_well_known_figures() -> None:
    chamfer = published(DILIGENT_MV, [AVERAGE], "rnbneus", "chamfer_mm")
    assert {f.method: f.value for f in chamfer} == {
        "PJ16": 0.62, "LZ20": 0.22, "UA-MVPS": 0.37, "PS-NeRF": 0.28, "Kaya23": 0.28, "MVPSNet": 0.27, "RNb-NeuS": 0.23,
    }  # fmt: skip
    bear = published(DILIGENT_MV, ["BEAR"], "psnerf", "normal_error_deg", "MVPS methods")
    assert {f.method: f.value for f in bear} == {"PJ16": 12.78, "LZ20": 4.39, "PS-NeRF": 3.54}
    test_views = published(DILIGENT_MV, ["BEAR"], "psnerf", "normal_error_deg", "neural rendering methods")
    assert {f.method: f.value for f in test_views}["PS-NeRF"] == 3.21
    bunny = published("Synth-PS", ["BUNNY"], "psnerf", "normal_error_deg")
    assert {f.method: f.value for f in bunny if f.method in ("DPIR", "PS-GS")} == {"DPIR": 5.5, "PS-GS": 3.5}
    assert published(DILIGENT_MV, None, "psnerf", "average_psnr_db") and not published("DTU", None, "psnerf", "chamfer")


@pytest.mark.parametrize(
    ("name", "views", "lights", "found"),
    [
        ("bearPNG", 20, 96, "BEAR"),
        ("pot2PNG", 20, 96, "POT2"),
        ("READINGpng", 20, 96, "READING"),
        ("Cow", 20, 96, "COW"),
        ("buddha", 20, 96, "BUDDHA"),
        ("buddha", 20, 64, None),
        ("bearPNG", 1, 96, None),
        ("bunny", 20, 96, None),
        ("bearPNG_2", 20, 96, None),
    ],
)
def test_objects_are_known_by_name_and_numbers(name: str, views: int, lights: int, found: str | None) -> None:
    assert diligent_object(name, views, lights) == found
