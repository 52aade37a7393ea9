"""Captures that are damaged: photographs, masks and poses of a good one changed by an amount.

Every function takes a capture, the amount (its unit is the function's) and a random generator, and returns another capture; the truth
stays that of the good one. Outside of the masks photographs are black.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, map_coordinates
from scipy.spatial.transform import Rotation

from mvps.camera import project
from mvps.distortion import free_of_lens
from mvps.scene import Bool, Camera, Capture, Float, View
from mvps.synthetic.scene import WHITE, make_scene, photograph_scene
from mvps.synthetic.settings import SceneSettings

Damage = Callable[[Capture, float, np.random.Generator], Capture]


def each_view(capture: Capture, change: Callable[[View], View]) -> Capture:
    """The capture with every view changed."""
    return Capture(capture.name, tuple(change(view) for view in capture.views))


def one_view(capture: Capture, k: int, change: Callable[[View], View]) -> Capture:
    """The capture with view k changed."""
    return Capture(capture.name, tuple(change(view) if i == k else view for i, view in enumerate(capture.views)))


def some_view(capture: Capture, rng: np.random.Generator) -> int:
    """A view by chance."""
    return int(rng.integers(len(capture.views)))


# ------------------------------------------------------------------------------------------------ photographs


def with_values(view: View, values: Float) -> View:
    """The view with other samples (pixels, lights, 3), 1 the largest; what is larger is clipped."""
    return replace(view, samples=np.rint(np.clip(values, 0, 1) * WHITE).astype(np.uint16))


def fewer_bits(capture: Capture, bits: float, rng: np.random.Generator) -> Capture:
    """Code values of this many bits, stretched to 16."""
    top = 2 ** round(bits) - 1
    return each_view(capture, lambda view: with_values(view, np.rint(view.radiance() * top) / top))


def exposed_anew(capture: Capture, spread: float, rng: np.random.Generator) -> Capture:
    """Every view with an exposure of its own, of this standard deviation of its logarithm; the longest as it was, none clipped."""
    return _dimmed(capture, [np.exp(rng.normal(0, spread, 1)) for _ in capture.views])


def flickering(capture: Capture, spread: float, rng: np.random.Generator) -> Capture:
    """The same of every photograph by itself, as lamps that flicker or flashes that differ from shot to shot."""
    return _dimmed(capture, [np.exp(rng.normal(0, spread, len(view.lights))) for view in capture.views])


def _dimmed(capture: Capture, strengths: list[Float]) -> Capture:
    """Photographs as many times as bright as these (lights,) or (1,) of the views, over the largest of all."""
    each = iter([of_view / max(one.max() for one in strengths) for of_view in strengths])
    return each_view(capture, lambda view: with_values(view, view.radiance() * next(each)[:, None]))


def gamma(capture: Capture, exponent: float, rng: np.random.Generator) -> Capture:
    """Code values radiance^(1 / exponent)."""
    return each_view(capture, lambda view: with_values(view, view.radiance() ** (1 / exponent)))


def ambient(capture: Capture, share: float, rng: np.random.Generator) -> Capture:
    """The same light added to every photograph, from where the lights are: a view's mean over its lights, its median `share` of theirs."""

    def lit(view: View) -> View:
        mean = view.radiance().mean(1, keepdims=True)
        return with_values(view, view.radiance() + share * np.median(view.radiance()) / np.median(mean) * mean)

    return each_view(capture, lit)


def black_level(capture: Capture, share: float, rng: np.random.Generator) -> Capture:
    """This share of full scale in every sample, all else below it darker by as much."""
    return each_view(capture, lambda view: with_values(view, share + (1 - share) * view.radiance()))


def two_swapped(capture: Capture, _: float, rng: np.random.Generator) -> Capture:
    """Two photographs of one view in each other's place."""
    k = some_view(capture, rng)
    order = np.arange(len(capture.views[k].lights))
    order[[0, len(order) // 2]] = order[[len(order) // 2, 0]]
    return one_view(capture, k, lambda view: replace(view, samples=view.samples[:, order]))


def with_photograph(view: View, light: int, image: Float) -> View:
    """One photograph replaced by radiance (pixels, 3)."""
    values = view.radiance()
    values[:, light] = image
    return with_values(view, values)


def one_black(capture: Capture, _: float, rng: np.random.Generator) -> Capture:
    """One photograph is black."""
    k = some_view(capture, rng)
    return one_view(capture, k, lambda view: with_photograph(view, int(rng.integers(len(view.lights))), np.zeros(3)))


def one_foreign(capture: Capture, _: float, rng: np.random.Generator) -> Capture:
    """One photograph shows another object from the same camera, turned into half a circle."""
    k = some_view(capture, rng)
    view = capture.views[k]
    other = make_scene(SceneSettings(views=2, lights=len(view.lights), size=view.camera.width, seed=1000))
    camera = other.cameras[1]
    alone = replace(
        other, cameras=(camera,), lights=replace(other.lights, direction=other.lights.direction[1:], intensity=other.lights.intensity[1:])
    )
    masks, radiances, _others = photograph_scene(alone)
    (mask,), (radiance,) = masks, radiances
    light = int(rng.integers(len(view.lights)))
    image = np.zeros((*mask.shape, 3))
    image[mask] = radiance[:, light] / np.quantile(radiance, 0.999)
    return one_view(capture, k, lambda view: with_photograph(view, light, image[view.mask]))


# ------------------------------------------------------------------------------------------------ masks


def with_mask(view: View, mask: Bool) -> View:
    """The view with another mask."""
    image = np.zeros((*mask.shape, *view.samples.shape[1:]), np.uint16)
    image[view.mask] = view.samples
    return replace(view, mask=mask, samples=image[mask])


def grown(capture: Capture, px: float, rng: np.random.Generator) -> Capture:
    """Masks that reach this much too far; too little where negative."""

    def change(view: View) -> View:
        outside = distance_transform_edt(~view.mask) if px > 0 else distance_transform_edt(view.mask)
        return with_mask(view, outside <= px if px > 0 else outside > -px)

    return each_view(capture, change)


def shrunk(capture: Capture, px: float, rng: np.random.Generator) -> Capture:
    """Masks that reach this much too little."""
    return grown(capture, -px, rng)


def background(view: View) -> NDArray[np.uint16]:
    """(lights, 3) what a grey wall behind the object shows: as bright as the object under the same light, in the median."""
    shown: NDArray[np.uint16] = np.median(view.samples, 0).astype(np.uint16)
    return shown


def before_bright(capture: Capture, px: float, rng: np.random.Generator) -> Capture:
    """Masks that reach this much too far, where photographs show a wall (`background`)."""

    def change(view: View) -> View:
        wide = with_mask(view, distance_transform_edt(~view.mask) <= px)
        samples = wide.samples.copy()
        samples[~view.mask[wide.mask]] = background(view)
        return replace(wide, samples=samples)

    return each_view(capture, change)


def disc(view: View, at: Float, radius: float) -> Bool:
    """(height, width) True around a pixel (2,)."""
    rows, columns = np.indices(view.mask.shape)
    inside: Bool = (rows - at[0]) ** 2 + (columns - at[1]) ** 2 <= radius**2
    return inside


def holed(capture: Capture, radius: float, rng: np.random.Generator) -> Capture:
    """Five round holes of this radius, pixels, in every mask."""

    def change(view: View) -> View:
        mask = view.mask.copy()
        for at in view.pixels[rng.integers(len(view.pixels), size=5)]:
            mask &= ~disc(view, at, radius)
        return with_mask(view, mask)

    return each_view(capture, change)


def blobbed(capture: Capture, radius: float, rng: np.random.Generator) -> Capture:
    """A round blob of this radius, pixels, beside the object in one mask, where the photograph is black."""
    k = some_view(capture, rng)
    free = distance_transform_edt(~capture.views[k].mask)
    places = np.argwhere(free > min(radius + 2, free.max() - 1))
    at = places[rng.integers(len(places))]
    return one_view(capture, k, lambda view: with_mask(view, view.mask | disc(view, at, radius)))


def limb_missing(capture: Capture, share: float, rng: np.random.Generator) -> Capture:
    """One mask ends where this share of the object's width is still to come."""
    k = some_view(capture, rng)
    columns = capture.views[k].pixels[:, 1]
    end = columns.max() - share * np.ptp(columns)
    return one_view(capture, k, lambda view: with_mask(view, view.mask & (np.arange(view.camera.width) < end)))


# ------------------------------------------------------------------------------------------------ cameras


def points_of(capture: Capture) -> Float:
    """(8, 3) corners of a cube about where the object is: where the optical axes meet, as wide as the masks."""
    cameras = [view.camera for view in capture.views]
    across = [np.eye(3) - np.outer(c.rotation[2], c.rotation[2]) for c in cameras]
    if len(cameras) > 1:
        middle = np.linalg.lstsq(sum(across), sum(P @ c.centre for P, c in zip(across, cameras, strict=True)), rcond=None)[0]
    else:
        middle = np.zeros(3)
    depth = project(cameras[0], middle[None])[1][0]
    half = np.ptp(capture.views[0].pixels[:, 1]) / 2 * depth / cameras[0].focal_length
    cube: Float = middle + half / np.sqrt(3) * (np.indices((2, 2, 2)).reshape(3, -1).T * 2 - 1)
    return cube


def moved(camera: Camera, points: Float, px: float, rng: np.random.Generator) -> Camera:
    """The camera turned and shifted by chance, so that points (n, 3) move by `px` pixels in the mean square."""
    middle = points.mean(0)
    depth, radius = project(camera, middle[None])[1][0], np.linalg.norm(points - middle, axis=1).max()
    turn, shift = rng.normal(size=3), rng.normal(size=3) * (1, 1, depth / radius)

    def by(scale: float) -> Camera:
        # About the object's middle: a turn and a shift of a pixel each, at scale 1.
        pixel = depth / camera.focal_length
        rotation = Rotation.from_rotvec(scale * turn * pixel / radius).as_matrix()
        at = camera.rotation @ middle + camera.translation
        return replace(
            camera, rotation=rotation @ camera.rotation, translation=rotation @ (camera.translation - at) + at + scale * pixel * shift
        )

    scale = 1.0
    for _ in range(3):
        step = np.sqrt(((project(by(scale), points)[0] - project(camera, points)[0]) ** 2).sum(1).mean())
        scale *= px / step
    return by(scale)


def poses_off(capture: Capture, px: float, rng: np.random.Generator) -> Capture:
    """Every camera moved by chance so that the object's projection moves by this many pixels."""
    points = points_of(capture)
    return each_view(capture, lambda view: replace(view, camera=moved(view.camera, points, px, rng)))


def pose_of_another(capture: Capture, _: float, rng: np.random.Generator) -> Capture:
    """One view with its neighbour's pose."""
    k = some_view(capture, rng)
    other = capture.views[(k + 1) % len(capture.views)].camera
    return one_view(
        capture, k, lambda view: replace(view, camera=replace(view.camera, rotation=other.rotation, translation=other.translation))
    )


def principal_point_off(capture: Capture, px: float, rng: np.random.Generator) -> Capture:
    """The principal point of all views is this many pixels off, along one direction."""
    angle = rng.uniform(0, 2 * np.pi)
    shift = np.zeros((3, 3))
    shift[:2, 2] = px * np.cos(angle), px * np.sin(angle)
    return each_view(capture, lambda view: replace(view, camera=replace(view.camera, K=view.camera.K + shift)))


def lens_given(capture: Capture, px: float, rng: np.random.Generator) -> Capture:
    """A calibration with a lens that bends the object's rim by this many pixels (k1 of lens.py), which photographs do not show."""

    def change(view: View) -> View:
        K = view.camera.K
        rim = np.linalg.norm((view.pixels[:, ::-1] + 0.5 - K[:2, 2]) / K.diagonal()[:2], axis=1).max()
        return replace(view, camera=replace(view.camera, distortion=(px / (view.camera.focal_length * rim**3), 0.0, 0.0, 0.0, 0.0)))

    return each_view(capture, change)


def lens(capture: Capture, px: float, rng: np.random.Generator) -> Capture:
    """Such a calibration, and photographs and masks that show it."""

    def change(view: View) -> View:
        columns_and_rows = np.indices(view.mask.shape)[::-1].reshape(2, -1).T
        free = free_of_lens(view.camera, columns_and_rows + 0.5)[:, ::-1] - 0.5

        def at(image: Float) -> Float:
            shown: Float = map_coordinates(image, free.T, order=1).reshape(view.mask.shape)
            return shown

        share, image = at(view.mask.astype(np.float64)), np.zeros((*view.mask.shape, len(view.lights), 3))
        mask, image[view.mask] = share > 0.5, view.samples
        values = [[at(image[..., k, c])[mask] / share[mask] for c in range(3)] for k in range(len(view.lights))]
        return replace(view, mask=mask, samples=np.rint(np.moveaxis(np.array(values), -1, 0)).astype(np.uint16))

    return each_view(lens_given(capture, px, rng), change)
