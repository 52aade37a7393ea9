"""mvps.edits: what a file of edits does to a material, and what it refuses."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from sphere_scene import make_sphere

from mvps.edits import clusters, edited, read_edits, turned_hue
from mvps.pbr import reflectance_scale, specular_energy
from mvps.scene import CaptureError, Material

SCENE = make_sphere(3)
SURFACE, MATERIAL = SCENE.reconstruction.surface, SCENE.reconstruction.material
CAMERAS = {view.name: view.camera for view in SCENE.capture.views}


def after(*edits: dict[str, Any]) -> Material:
    return edited(SURFACE, MATERIAL, edits, CAMERAS)


def test_albedo_by_colour_factor_and_hue() -> None:
    white = reflectance_scale(MATERIAL)
    np.testing.assert_allclose(
        after({"albedo": {"colour": [0.2, 0.4, 0.6]}}).albedo, np.tile([0.2, 0.4, 0.6], (len(MATERIAL.albedo), 1)) * white
    )
    np.testing.assert_allclose(after({"albedo": {"factor": [2, 1, 0]}}).albedo, MATERIAL.albedo * (2, 1, 0))
    np.testing.assert_allclose(
        turned_hue(np.array([[0.8, 0.1, 0.1], [0.3, 0.3, 0.3]]), 120), [[0.1, 0.8, 0.1], [0.3, 0.3, 0.3]], atol=1e-12
    )


def test_sharper_highlights_keep_their_energy() -> None:
    sharper = after({"specular": {"sharpness_factor": 4}})
    before, then = (specular_energy(m.specular_weight, m.sharpness) for m in (MATERIAL, sharper))
    np.testing.assert_allclose(then, before)
    assert sharper.sharpness.tolist() == [12, 60, 48, 240] and not sharper.specular_weight[:, :2].any()
    np.testing.assert_allclose(after({"specular": {"factor": 0.5}}).specular_weight, MATERIAL.specular_weight / 2)


def test_a_preset_reflects_what_it_says() -> None:
    gold = after({"preset": "gold"})
    white = reflectance_scale(MATERIAL)
    np.testing.assert_allclose(
        specular_energy(gold.specular_weight, gold.sharpness), np.tile([1.0, 0.78, 0.34], (len(gold.albedo), 1)) * white
    )
    assert not gold.albedo.any() and not after({"preset": "matte"}).specular_weight.any()


def test_white_is_that_before_any_edit(tmp_path: Path) -> None:
    """The same edit again changes nothing, and gloss is as strong on what was made dark or black."""
    white = reflectance_scale(MATERIAL)
    grey, dark, gone = ({"albedo": edit} for edit in ({"colour": [0.5] * 3}, {"colour": [0.02] * 3}, {"factor": 0}))
    matte, glossy = {"preset": "matte"}, {"preset": "glossy"}
    np.testing.assert_allclose(after(matte, *3 * [grey]).albedo, 0.5 * white)
    for edits in ([glossy, dark], [matte, dark, glossy], [matte, gone, glossy], [matte | gone, glossy]):
        made = after(*edits)
        np.testing.assert_allclose(specular_energy(made.specular_weight, made.sharpness), 0.04 * white, err_msg=str(edits))
    view = SCENE.capture.views[0]
    cv2.imwrite(str(tmp_path / "over.png"), np.full((*view.mask.shape, 3), 255, np.uint8))
    painted = {"albedo": {"painted": str(tmp_path / "over.png"), "view": "view_01"}}
    made = after(matte, gone, painted)
    np.testing.assert_allclose(made.albedo[made.albedo.any(1)], white)
    np.testing.assert_array_equal(after(matte, gone, painted, painted).albedo, made.albedo)


def test_a_painted_region_is_what_its_camera_sees(tmp_path: Path) -> None:
    view = SCENE.capture.views[0]
    mask = np.zeros(view.mask.shape, np.uint8)
    mask[:, 48:] = 255
    cv2.imwrite(str(tmp_path / "half.png"), mask)
    path = tmp_path / "edits.json"
    path.write_text(json.dumps({"edits": [{"region": {"view": "view_01", "mask": "half.png"}, "albedo": {"factor": 0}}]}))
    black = ~edited(SURFACE, MATERIAL, read_edits(path), CAMERAS).albedo.any(1)
    local = SURFACE.vertices @ view.camera.rotation.T
    assert black.any() and (local[black, 0] >= 0).all() and (local[black, 2] < 0).all()
    assert black.mean() == pytest.approx(0.25, abs=0.06)


def test_a_painted_picture_covers_what_its_camera_sees(tmp_path: Path) -> None:
    """Opaque red on the right, half of it in the middle rows, clear on the left; nothing behind changes."""
    view = SCENE.capture.views[0]
    height, width = view.mask.shape
    picture = np.zeros((height, width, 4), np.uint8)
    picture[:, width // 2 :] = (0, 0, 255, 255)
    cv2.imwrite(str(tmp_path / "over.png"), picture)
    path = tmp_path / "edits.json"
    path.write_text(json.dumps({"edits": [{"albedo": {"painted": "over.png", "view": "view_01"}}]}))
    found = edited(SURFACE, MATERIAL, read_edits(path), CAMERAS).albedo
    local = SURFACE.vertices @ view.camera.rotation.T
    red = np.isclose(found, np.array([1.0, 0, 0]) * reflectance_scale(MATERIAL)).all(1)
    same = np.isclose(found, MATERIAL.albedo).all(1)
    assert red.mean() > 0.1 and (local[red, 0] > 0).all() and (local[red, 2] < 0).all()
    assert same[local[:, 2] > 0].all() and same[local[:, 0] < -2].all() and (red | same).mean() > 0.9
    cv2.imwrite(str(tmp_path / "over.png"), picture[:-1])
    with pytest.raises(CaptureError, match=r"over.png: wanted a painted picture as PNG, \d+ x \d+ pixels, given"):
        edited(SURFACE, MATERIAL, read_edits(path), CAMERAS)


def of_two_kinds(shiny: Any) -> Material:
    return replace(MATERIAL, albedo=np.ones_like(MATERIAL.albedo), specular_weight=np.where(shiny[:, None], [0.5, 0.5], [0.05, 0.0]))


def test_a_mask_may_be_white_throughout_but_not_black(tmp_path: Path) -> None:
    view = SCENE.capture.views[0]
    edit = {"region": {"view": "view_01", "mask": str(tmp_path / "all.png")}, "albedo": {"factor": 0}}
    cv2.imwrite(edit["region"]["mask"], np.full(view.mask.shape, 255, np.uint8))
    black = ~after(edit).albedo.any(1)
    towards = (SURFACE.vertices @ view.camera.rotation.T)[:, 2]
    assert (towards[black] < 0).all() and black.mean() == pytest.approx(0.5, abs=0.1)
    cv2.imwrite(edit["region"]["mask"], np.zeros(view.mask.shape, np.uint8))
    with pytest.raises(CaptureError, match=r"wanted a mask with some white, given .*/test_a_mask"):
        after(edit)


def test_kinds_are_those_before_any_edit() -> None:
    """The first kind polished is the glossiest, but the first it stays."""
    shiny = SURFACE.vertices[:, 2] > 0
    first: dict[str, Any] = {"region": {"cluster": 1, "of": 2}}
    found = edited(SURFACE, of_two_kinds(shiny), [first | {"preset": "polished"}, first | {"albedo": {"factor": 0}}], {})
    assert ((found.albedo[:, 0] == 0) == ~shiny).all()


@pytest.mark.filterwarnings("error")
def test_kinds_of_a_rare_material_and_more_kinds_than_there_are() -> None:
    shiny = SURFACE.vertices[:, 2] > 0.6 * SURFACE.vertices[:, 2].max()
    material = of_two_kinds(shiny)
    assert shiny.mean() < 0.25 and ((clusters(SURFACE, material, 2) == 1) == shiny).all()
    matte = replace(material, specular_weight=np.zeros((len(shiny), 0)), sharpness=np.zeros(0))
    for there, given in ((2, material), (1, matte)):
        with pytest.raises(CaptureError, match=f"edit 1: wanted at most {there} kinds of material, as many as there are, given of 16"):
            edited(SURFACE, given, [{"region": {"cluster": 1, "of": 16}, "preset": "gold"}], {})


def test_kinds_of_material_are_found_from_the_weights() -> None:
    shiny = SURFACE.vertices[:, 2] > 0
    material = of_two_kinds(shiny)
    assert ((clusters(SURFACE, material, 2) == 1) == shiny).all()
    # Single vertices that noise puts to the other kind follow their neighbours.
    speck = np.abs(SURFACE.vertices[:, 2]) > 0.6 * np.abs(SURFACE.vertices[:, 2]).max()
    speck &= np.arange(len(speck)) % 7 == 0
    noisy = replace(material, specular_weight=np.where((shiny ^ speck)[:, None], [0.5, 0.5], [0.05, 0.0]))
    assert speck.sum() > 3 and ((clusters(SURFACE, noisy, 2) == 1) == shiny).all()
    changed = edited(SURFACE, material, [{"region": {"cluster": 2, "of": 2}, "albedo": {"factor": 0.5}}], {})
    assert ((changed.albedo[:, 0] < 1) == shiny).all()


@pytest.mark.parametrize(
    ("edit", "said"),
    [
        ({"preset": "velvet"}, 'wanted one of matte, .* as preset, given "velvet"'),
        ({"preset": ["gold"]}, "wanted one of matte, .* as preset, given"),
        ({"albedo": {"colour": [1, -1, 0]}}, "wanted numbers of 0 to 1e[+]06 as colour, given -1"),
        ({"albedo": {"factor": True}}, "wanted numbers of 0 to 1e[+]06 as factor, given true"),
        ({"albedo": {"factor": [1, 2]}}, r"wanted a number or three, one per channel, as factor, given \[1, 2\]"),
        ({"albedo": {"factor": 10**400}}, "wanted numbers of 0 to 1e[+]06 as factor, given 1000.*[.][.][.];"),
        ({"albedo": {"hue_deg": -(10**400)}}, "wanted numbers of -1e[+]06 to 1e[+]06 as hue_deg, given -1000"),
        ({"albedo": {"hue_deg": float("nan")}}, "hue_deg, given NaN"),
        ({"albedo": {"shade": 3}}, "wanted painted and view, or some of colour, factor, hue_deg as albedo, given {"),
        ({"albedo": None}, "as albedo, given null"),
        ({"albedo": {"painted": "x.png"}}, "wanted painted and view, or .* as albedo, given {"),
        ({"specular": 3}, "wanted some of factor, sharpness_factor as specular, given 3"),
        ({"specular": {"sharpness_factor": 0}}, "wanted numbers of 1e-06 to 1e[+]06 as sharpness_factor, given 0"),
        ({"region": {"view": "view_77", "mask": "x.png"}, "preset": "gold"}, "wanted a view among view_01"),
        ({"region": {"view": ["view_01"], "mask": "x.png"}, "preset": "gold"}, "wanted a view among view_01"),
        ({"region": {"view": "view_01", "mask": 3}, "preset": "gold"}, "wanted a PNG file as mask, given 3, which is not there"),
        ({"region": {"view": "view_01", "mask": "a\0b"}, "preset": "gold"}, "wanted a PNG file as mask"),
        ({"region": {"view": "view_01", "mask": "."}, "preset": "gold"}, "wanted a painted picture as PNG, .* cannot be read"),
        ({"region": {"cluster": 1, "of": 99}, "preset": "gold"}, "of from 1 to 16 and cluster from 1 to of, given cluster 1 of 99"),
        ({"region": {"cluster": 1.7, "of": 2.9}, "preset": "gold"}, "wanted whole numbers, .* given cluster 1.7 of 2.9"),
        ({"region": {"cluster": 1, "of": float("inf")}, "preset": "gold"}, "given cluster 1 of Infinity"),
        ({"region": {"cluster": 4, "of": 3}, "preset": "gold"}, "cluster 4 of 3"),
        ({"region": {"cluster": 0, "of": 3}, "preset": "gold"}, "cluster 0 of 3"),
        ({"region": {"cluster": 1, "of": 3, "colour": 2}, "preset": "gold"}, "wanted mask and view, or cluster and of as region, given {"),
        ({"specular": {"sharpness_factor": 1e300}}, "sharpness_factor"),
        ({"albedo": {"painted": "x.png", "view": "view_77"}}, "wanted a view among view_01"),
        ({"albedo": {"painted": "nowhere.png", "view": "view_01"}}, 'wanted a PNG file as painted, given "nowhere.png", which'),
        ({"albedo": {"painted": "x.png", "view": "view_01", "factor": 2}}, "wanted painted and view, or some of"),
    ],
)
def test_wrong_edits_are_refused(edit: dict[str, Any], said: str) -> None:
    with pytest.raises(CaptureError, match="edit 2: .*" + said):
        after({}, edit)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('{"edits": [], "more": 1}', 'wanted {"edits": .*}, given {"edits": .*, "more": 1}'),
        ("", "wanted JSON"),
        ("[" * 100000, "wanted JSON"),
        ('{"edits": [1e999]}', "wanted JSON, .* not finite"),
        (f'{{"edits": [{"9" * 5000}]}}', r"wanted JSON, .*the number 9{20}[.]{3}, of 5000 digits\);"),
        ("{}", "wanted .* given {}"),
        ("[]", r"wanted .* given \[\]"),
        ('{"edits": 3}', "wanted .* given"),
        ('{"edits": [{}, {"colour": 1}]}', "edit 2: wanted some of albedo, preset, region, specular, given"),
        ('{"edits": [3]}', "edit 1: wanted some of .* given 3"),
    ],
)
def test_wrong_files_are_refused(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "e.json").write_text(text)
    with pytest.raises(CaptureError, match=f"e.json: {said}"):
        read_edits(tmp_path / "e.json")


def test_complaints_name_the_file_and_the_edit(tmp_path: Path) -> None:
    mask = np.zeros((3, 5), np.uint8)
    cv2.imwrite(str(tmp_path / "small.png"), mask)
    for wrong, said in (
        ({"preset": "velvet"}, "wanted one of matte"),
        ({"region": {"view": "view_01", "mask": "small.png"}, "preset": "gold"}, r"\S*small.png: wanted .* pixels, given 5 x 3"),
    ):
        (tmp_path / "e.json").write_text(json.dumps({"edits": [{"preset": "gold"}, wrong]}))
        with pytest.raises(CaptureError, match=f"e.json: edit 2: {said}"):
            edited(SURFACE, MATERIAL, read_edits(tmp_path / "e.json"), CAMERAS)


def test_what_is_no_file_is_refused_and_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", Path("/dev/zero"), tmp_path, tmp_path / "nowhere"):
        with pytest.raises(CaptureError, match=f"{path}: wanted a file of edits, given one that cannot be read"):
            read_edits(path)
