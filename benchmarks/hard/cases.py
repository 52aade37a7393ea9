"""The hard cases by name, and cases by chance.

A case is a good capture with its truth, and what the program is given: the same, or the same damaged.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hard import damage, scenes
from hard.damage import Damage
from hard.lumps import lumps
from hard.scenes import BASE, Change, rendered
from mvps.scene import Capture, Surface, Truth, View
from mvps.synthetic.scene import WHITE, Photograph
from mvps.synthetic.settings import SceneSettings


class Sample(NamedTuple):
    """The capture that the program is given, the good one, and the good one's truth; behind: what some pixels (n,) of a good view's k-th
    photograph show behind the object, (n, 3), where that is not black."""

    given: Capture
    good: Capture
    truth: Truth
    behind: Callable[[View, int, int], NDArray[np.uint16]] | None = None


class Case(NamedTuple):
    """A group of the table, and the case's maker."""

    group: str
    make: Callable[[], Sample]


@lru_cache(maxsize=1)
def base(settings: SceneSettings = BASE) -> tuple[Capture, Truth]:
    """The good capture that is damaged."""
    return rendered(settings)


def of_scene(settings: SceneSettings = BASE, change: Change | None = None, take: Photograph | None = None) -> Sample:
    """A scene as it is photographed."""
    good, truth = rendered(settings, change, take)
    return Sample(good, good, truth)


def of_shape(shape: Callable[[], Surface], take: Photograph | None = None, arc: float = 2 * np.pi) -> Sample:
    """Another object under the base's settings."""
    return of_scene(change=lambda _: scenes.shaped_as(shape(), arc=arc), take=take)


def damaged(by: Damage, amount: float, settings: SceneSettings = BASE) -> Sample:
    """The base, or one of other settings, damaged; chance starts anew for every case."""
    good, truth = base(settings)
    return Sample(by(good, amount, np.random.default_rng(0)), good, truth)


def bright(px: float) -> Sample:
    """The base in front of a bright wall, with masks that reach this much too far."""
    return damaged(damage.before_bright, px)._replace(behind=lambda view, k, n: np.broadcast_to(damage.background(view)[k], (n, 3)))


def with_black_level(share: float) -> Sample:
    """The base by a camera whose black level, this share of full scale, was left in, with the object's noise around it."""
    rng = np.random.default_rng(0)

    def behind(view: View, k: int, n: int) -> NDArray[np.uint16]:
        level: NDArray[np.uint16] = np.rint(WHITE * (share + rng.normal(0, BASE.noise, (n, 3)))).clip(0).astype(np.uint16)
        return level

    return damaged(damage.black_level, share)._replace(behind=behind)


def _number(value: float) -> str:
    return f"{value:g}".replace("+", "")


def _lights() -> Iterator[tuple[str, Callable[[], Sample]]]:
    for count in (1, 2, 3, 4, 8):
        yield f"lights-{count}", partial(of_scene, replace(BASE, lights=count))
    yield "lights-free", partial(of_scene, replace(BASE, free_lights=True))
    metal = partial(scenes.made_of, albedo=0.0, weight=(0.4, 1.0), sharpness=(12.0, 90.0))
    yield "lights-free-metal", partial(of_scene, replace(BASE, free_lights=True, exposure=0.98), change=metal)
    yield "lights-fixed", partial(of_scene, change=partial(scenes.lamps, count=24))
    yield "lights-fixed-3", partial(of_scene, change=partial(scenes.lamps, count=3))
    yield "lights-cone-15-deg", partial(of_scene, replace(BASE, spread=15.0))
    yield "lights-one-plane", partial(of_scene, change=scenes.in_one_plane)
    yield "lights-1-to-100", partial(of_scene, change=lambda scene: scenes.unequal(scene, 100))
    yield "lights-coloured", partial(of_scene, change=scenes.coloured)
    for sizes in (3, 10):
        yield f"lights-near-{sizes}-sizes", partial(of_scene, take=scenes.near(sizes * BASE.extent))


def _views() -> Iterator[tuple[str, Callable[[], Sample]]]:
    for count in (1, 2, 3, 5):
        yield f"views-{count}", partial(of_scene, replace(BASE, views=count))
    yield "views-from-above", partial(of_scene, change=scenes.from_above)


def _materials() -> Iterator[tuple[str, Callable[[], Sample]]]:
    kinds: dict[str, tuple[float | None, tuple[float, ...] | None, tuple[float, ...]]] = {
        "near-mirror": (0.02, (20.0,), (2000.0,)),
        "metal": (0.0, (0.4, 1.0), (12.0, 90.0)),
        "black": (0.02, None, ()),
        "wide-lobes": (0.2, (0.6, 0.3), (2.0, 5.0)),
    }
    for name, (albedo, weight, sharpness) in kinds.items():
        # Photographers let such highlights clip: else all the rest is dark.
        settings = replace(BASE, exposure=0.98) if name in ("near-mirror", "metal") else BASE
        yield (
            f"material-{name}",
            partial(of_scene, settings, change=partial(scenes.made_of, albedo=albedo, weight=weight, sharpness=sharpness)),
        )


def _photographs() -> Iterator[tuple[str, Callable[[], Sample]]]:
    for percent in (1, 5, 20):
        yield f"saturated-{percent}-percent", partial(of_scene, replace(BASE, exposure=1 - percent / 100))
    for percent in (1, 3, 10):
        yield f"noise-{percent}-percent", partial(of_scene, replace(BASE, noise=percent / 100))
    yield "8-bits", partial(damaged, damage.fewer_bits, 8)
    yield "gamma-2.2", partial(damaged, damage.gamma, 2.2)
    yield "gamma-2.2-6-lights", partial(damaged, damage.gamma, 2.2, replace(BASE, lights=6))
    yield "gamma-2.2-noise-3-percent", partial(damaged, damage.gamma, 2.2, replace(BASE, noise=0.03))
    for percent in (5, 20):
        yield f"ambient-{percent}-percent", partial(damaged, damage.ambient, percent / 100)
    for percent in (1, 4):
        yield f"black-level-{percent}-percent", partial(with_black_level, percent / 100)
    for percent in (10, 40):
        yield f"exposures-{percent}-percent", partial(damaged, damage.exposed_anew, percent / 100)
    for percent in (3, 10):
        yield f"flicker-{percent}-percent", partial(damaged, damage.flickering, percent / 100)
    yield "images-swapped", partial(damaged, damage.two_swapped, 1)
    yield "image-black", partial(damaged, damage.one_black, 1)
    yield "image-of-another-object", partial(damaged, damage.one_foreign, 1)


def _masks() -> Iterator[tuple[str, Callable[[], Sample]]]:
    for px in (1, 3, 6):
        yield f"masks-grown-{px}-px", partial(damaged, damage.grown, px)
        yield f"masks-shrunk-{px}-px", partial(damaged, damage.shrunk, px)
    for px in (0, 3):
        yield f"masks-grown-{px}-px-bright", partial(bright, px)
    yield "masks-holes", partial(damaged, damage.holed, 3)
    yield "mask-blob", partial(damaged, damage.blobbed, 6)
    yield "mask-limb-missing", partial(damaged, damage.limb_missing, 0.2)


def _cameras() -> Iterator[tuple[str, Callable[[], Sample]]]:
    for px in (0.2, 1, 3):
        yield f"poses-off-{_number(px)}-px", partial(damaged, damage.poses_off, px)
    yield "pose-of-another-view", partial(damaged, damage.pose_of_another, 1)
    for px in (2, 8):
        yield f"principal-point-off-{px}-px", partial(damaged, damage.principal_point_off, px)
    yield "lens-3-px", partial(damaged, damage.lens, 3)
    yield "lens-3-px-undone", partial(damaged, damage.lens_given, 3)


def _shapes() -> Iterator[tuple[str, Callable[[], Sample]]]:
    for px in (0.5, 1, 2, 3):
        yield f"shape-rods-{_number(px)}-px", partial(of_shape, partial(scenes.rods, px))
    yield "shape-rings-2-px", partial(of_shape, partial(scenes.rings, 2.0))
    for name in ("bowl", "touching", "chain", "slab", "sphere"):
        yield f"shape-{name}", partial(of_shape, getattr(scenes, name))
    yield "shape-bowl-lit-within", partial(of_shape, scenes.bowl, scenes.lit_between)
    for name, height in (("plane", 0.0), ("open", 0.08)):
        yield f"shape-{name}", partial(of_shape, partial(scenes.sheet, height), arc=scenes.ARC)
    yield "shape-cut-by-border", partial(of_scene, change=lambda scene: scenes.zoomed(scene, 1.4))


def _sizes() -> Iterator[tuple[str, Callable[[], Sample]]]:
    for extent in (1e-6, 1e-3, 1e3, 1e6):
        yield f"unit-{_number(extent)}", partial(of_scene, replace(BASE, extent=extent))
    for size, views, lights in ((64, 8, 10), (512, 4, 8), (1024, 3, 6)):
        yield f"image-{size}", partial(of_scene, replace(BASE, size=size, views=views, lights=lights))


GROUPS = {
    "views": _views,
    "lights": _lights,
    "materials": _materials,
    "photographs": _photographs,
    "masks": _masks,
    "cameras": _cameras,
    "shapes": _shapes,
    "units and sizes": _sizes,
}

CASES: dict[str, Case] = {"base": Case("base", of_scene)} | {
    name: Case(group, make) for group, cases in GROUPS.items() for name, make in cases()
}
"""All cases by name."""


# ------------------------------------------------------------------------------------------------ by chance

DEFECTS: dict[str, tuple[Damage, float, float]] = {
    "bits": (damage.fewer_bits, 6, 12),
    "gamma": (damage.gamma, 1.1, 2.4),
    "ambient": (damage.ambient, 0.02, 0.3),
    "images swapped": (damage.two_swapped, 1, 1),
    "image black": (damage.one_black, 1, 1),
    "image of another object": (damage.one_foreign, 1, 1),
    "masks grown px": (damage.grown, 0.5, 6),
    "masks shrunk px": (damage.shrunk, 1, 6),
    "holes px": (damage.holed, 1, 5),
    "blob px": (damage.blobbed, 2, 10),
    "limb missing": (damage.limb_missing, 0.05, 0.3),
    "poses off px": (damage.poses_off, 0.1, 4),
    "pose of another view": (damage.pose_of_another, 1, 1),
    "principal point off px": (damage.principal_point_off, 0.5, 10),
}
"""What cases by chance suffer, and between which amounts, evenly in the logarithm."""


OF_THE_MADE_OBJECT = 50
"""Cases by chance that show the made object; those after them show lumps, each others."""


def by_chance(number: int) -> tuple[Sample, str]:
    """A scene by chance with one or two defects, and what it is, in words. The same number gives the same case."""
    rng = np.random.default_rng((number, 7))
    settings = SceneSettings(
        views=int(rng.integers(3, 11)),
        lights=int(rng.integers(1, 13)),
        size=int(rng.integers(96, 129)),
        free_lights=bool(rng.random() < 0.2),
        strength=float(rng.uniform(0, 3)),
        noise=float(np.exp(rng.uniform(np.log(0.001), np.log(0.03)))),
        exposure=float(rng.uniform(0.93, 0.9995)),
        seed=number,
    )
    other = number >= OF_THE_MADE_OBJECT
    good, truth = rendered(settings, (lambda _: scenes.shaped_as(lumps(number), settings)) if other else None)
    of_lights = f"{settings.lights} lights{', free' * settings.free_lights}, noise {settings.noise:.3f}"
    given, words = good, [f"{'lumps, ' * other}{settings.views} views x {of_lights}"]
    for name in rng.choice(list(DEFECTS), size=rng.integers(1, 3), replace=False):
        by, least, most = DEFECTS[name]
        amount = float(np.exp(rng.uniform(np.log(least), np.log(most))))
        given = by(given, amount, rng)
        words.append(f"{name} {amount:.2g}" if least < most else name)
    return Sample(given, good, truth), ", ".join(words)
