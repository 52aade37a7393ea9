"""The values that travel between the parts of the program.

Frames   world: right-handed, units of the capture. camera: OpenCV axes (x right, y down, z forward),
         x_camera = rotation @ x_world + translation.
Pixels   image coordinates (x, y) are continuous, the first pixel's centre lies at (0.5, 0.5);
         arrays are indexed (row, column).
Vectors  normal, light and view are unit, world frame, and point away from the surface.
Light    radiance is linear; a light's intensity is its irradiance at normal incidence over the (unknown) exposure, so

             radiance = intensity * reflectance * max(normal . light, 0) * visibility,
             reflectance = albedo + sum_k specular_weight_k * exp(sharpness_k * (half . normal - 1)),    (more of it in shading.py)

         with albedo the diffuse reflectance without its 1/pi. Only the product intensity * reflectance is observable:
         intensities are relative and normalised to a mean of one over all lights and channels.

Every class is frozen and checked when it is made; arrays are made read-only, so that a value can be shared freely.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mvps.values import checked, unit

Float = NDArray[np.floating[Any]]
Int = NDArray[np.integer[Any]]
Bool = NDArray[np.bool_]

ROTATION_TOLERANCE = 1e-4
"""Largest entry of |R R^T - 1| that still counts as a rotation: calibration files print 5 or more digits."""


class CaptureError(ValueError):
    """Something is wrong with what the user gave; the message says where, what was wanted, what was given, what to try."""


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera: K (3, 3) pixels; rotation (3, 3), translation (3,) camera_from_world; a lens's k1 to k5 are for distortion.py."""

    K: Float
    rotation: Float
    translation: Float
    height: int
    width: int
    distortion: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        for name, shape in (("K", (3, 3)), ("rotation", (3, 3)), ("translation", (3,))):
            object.__setattr__(self, name, checked(name, getattr(self, name), shape))
        if self.K[0, 0] <= 0 or self.K[1, 1] <= 0 or abs(self.K[2] - (0, 0, 1)).max() > 1e-9:
            raise ValueError(f"K: wanted positive focal lengths and a last row of 0 0 1, given {self.K.tolist()}")
        off = np.abs(self.rotation @ self.rotation.T - np.eye(3)).max()
        if off > ROTATION_TOLERANCE or np.linalg.det(self.rotation) < 0:
            raise ValueError(
                f"rotation: wanted a right-handed orthonormal matrix, given one off by {off:.2g}"
                f" with determinant {np.linalg.det(self.rotation):.3g}"
            )
        if self.height < 1 or self.width < 1:
            raise ValueError(f"image size: wanted at least 1 x 1, given {self.height} x {self.width}")

    @cached_property
    def centre(self) -> Float:
        """The camera's centre in the world, (3,)."""
        return -self.rotation.T @ self.translation

    @property
    def focal_length(self) -> float:
        """Geometric mean of the two focal lengths, pixels."""
        return float(np.sqrt(self.K[0, 0] * self.K[1, 1]))


@dataclass(frozen=True, eq=False)
class View:
    """One camera position with its photographs, foreground pixels only.

    samples     (pixels, lights, 3) uint16, linear code values in the order of `pixels`
    mask        (height, width) bool
    scale       radiance = samples * scale
    saturation  code value at and above which a sample is clipped and no data
    lights      numbers of the photographs' lights, counted from 1 as in the files
    frame       (height, width) mean code value of every pixel over lights and channels, the background's too; None where not known
    files       the photographs, in the order of `lights`; none where they were not read from files
    black       code value that was taken off the files', for each channel
    """

    name: str
    camera: Camera
    mask: Bool
    samples: NDArray[np.uint16]
    scale: float
    saturation: int
    lights: tuple[int, ...]
    frame: NDArray[np.float32] | None = None
    files: tuple[Path, ...] = ()
    black: tuple[int, int, int] = (0, 0, 0)

    def __post_init__(self) -> None:
        object.__setattr__(self, "mask", checked("mask", self.mask, (self.camera.height, self.camera.width), bool))
        wanted = (int(self.mask.sum()), len(self.lights), 3)
        object.__setattr__(self, "samples", checked("samples", self.samples, wanted, np.uint16))
        if not self.scale > 0:
            raise ValueError(f"scale: wanted a positive number, given {self.scale}")

    def taken_by(self, camera: Camera) -> View:
        """The same photographs by another camera of the same image size; what was worked out of them is shared."""
        other = copy(self)
        object.__setattr__(other, "camera", camera)
        return other

    @cached_property
    def pixels(self) -> Int:
        """(pixels, 2) row and column of the foreground pixels, in row-major order."""
        return np.argwhere(self.mask).astype(np.int32)

    @cached_property
    def every_other(self) -> Int:
        """(n,) positions in `pixels` of half of them, like the white squares of a chessboard."""
        return np.flatnonzero(self.pixels.sum(1) % 2 == 0)

    @cached_property
    def pixel_index(self) -> Int:
        """(height, width) position of a pixel in `pixels`, -1 in the background."""
        index = np.full(self.mask.shape, -1, np.int32)
        index[self.mask] = np.arange(len(self.pixels), dtype=np.int32)
        return index

    def radiance(self, lights: slice | Sequence[int] = slice(None)) -> NDArray[np.float32]:
        """(pixels, lights, 3) float32 linear radiance of the lights at these positions."""
        return self.samples[:, lights].astype(np.float32) * np.float32(self.scale)

    def usable(self, lights: slice | Sequence[int] = slice(None)) -> Bool:
        """(pixels, lights) True where no channel is saturated."""
        return self._unclipped[:, lights]

    @cached_property
    def shown(self) -> Bool:
        """(lights,) True where a photograph has a usable sample: one that was left out (`Capture.without`) has none."""
        return np.asarray(self._unclipped.any(axis=0))

    @cached_property
    def _unclipped(self) -> Bool:
        below = self.samples < self.saturation
        return below[..., 0] & below[..., 1] & below[..., 2]


@dataclass(frozen=True, eq=False)
class Lights:
    """Directional lights of every view of a capture, in the order of its views.

    direction  per view (lights, 3) unit, world frame, from the surface towards the light
    intensity  per view (lights, 3) RGB, positive, relative
    one_rig    all views are under the same lights, which stand still in the camera's frame: rotation_i @ direction_i is all views'
    fixed      one rig that stands still in the world instead, while the camera moves: direction_i is the same for all views i
    """

    direction: tuple[Float, ...]
    intensity: tuple[Float, ...]
    one_rig: bool
    fixed: bool = False

    def __post_init__(self) -> None:
        if len(self.direction) != len(self.intensity):
            raise ValueError(f"lights: wanted as many intensities as directions, given {len(self.intensity)} and {len(self.direction)}")
        pairs = list(zip(self.direction, self.intensity, strict=True))
        object.__setattr__(self, "direction", tuple(checked("light direction", d, (None, 3)) for d, _ in pairs))
        object.__setattr__(self, "intensity", tuple(checked("light intensity", e, (len(d), 3)) for d, e in pairs))
        for direction, intensity in zip(self.direction, self.intensity, strict=True):
            unit("light direction", direction)
            if (intensity <= 0).any():
                raise ValueError(f"light intensity: wanted positive numbers, given {float(intensity.min()):.4g}")


@dataclass(frozen=True, eq=False)
class Capture:
    """The photographs of one object."""

    name: str
    views: tuple[View, ...]

    def __post_init__(self) -> None:
        if not self.views:
            raise ValueError("views: wanted at least one, given none")
        names = [view.name for view in self.views]
        if len(set(names)) != len(names):
            raise ValueError(f"views: wanted distinct names, given {names}")

    def without(self, photographs: Mapping[str, Sequence[int]]) -> Capture:
        """The capture in which these photographs, numbers of lights by view name, are no data: all their samples count as saturated."""
        views = []
        for view in self.views:
            if photographs.get(view.name):
                samples = view.samples.copy()
                samples[:, [view.lights.index(number) for number in photographs[view.name]]] = view.saturation
                views.append(replace(view, samples=samples))
            else:
                views.append(view)
        return Capture(self.name, tuple(views))

    def select(self, keep: Mapping[str, Sequence[int]]) -> Capture:
        """The capture with only the views named in `keep`, each with only the lights of these numbers."""
        views = []
        for view in self.views:
            if view.name in keep and tuple(keep[view.name]) == view.lights:
                # The samples are most of what the program holds: a copy only where something is left out.
                views.append(view)
            elif view.name in keep:
                positions = [view.lights.index(number) for number in keep[view.name]]
                files = tuple(view.files[at] for at in positions) if view.files else ()
                views.append(replace(view, samples=view.samples[:, positions], lights=tuple(keep[view.name]), files=files))
        return Capture(self.name, tuple(views))


RELIABLE = 0.2
"""Standard deviation of a normal, radians, at which its confidence is one half: there it no longer tells a slope from flat ground.
confidence = 1 / (1 + (sigma / RELIABLE)^2) with sigma the standard deviation along either tangent."""


def expected_error_deg(confidence: Float) -> Float:
    """Mean error, degrees, of normals with this confidence (n,): sqrt(pi / 2) times the standard deviation along a tangent."""
    error: Float = np.degrees(np.sqrt(np.pi / 2) * RELIABLE * np.sqrt(1 / np.clip(confidence, 1e-12, 1.0) - 1))
    return error.clip(max=90.0)  # Of a direction that a camera sees.


def less_confident(confidence: Float, variance: Float) -> Float:
    """Confidence (n,) of normals that have a further variance (n,) along a tangent, radians^2; 0 stays 0."""
    known = confidence > 0
    return np.where(known, 1 / (1 / np.where(known, confidence, 1) + variance / RELIABLE**2), 0.0)


@dataclass(frozen=True, eq=False)
class NormalMap:
    """Photometric stereo of one view, at its foreground pixels.

    normal (pixels, 3) unit, world frame; albedo (pixels, 3) RGB in units of radiance over intensity;
    confidence (pixels,) in the normal (RELIABLE), 0 where the pixel could not be solved (its normal then faces the camera).
    """

    normal: NDArray[np.float32]
    albedo: NDArray[np.float32]
    confidence: NDArray[np.float32]

    def __post_init__(self) -> None:
        n = len(self.confidence)
        object.__setattr__(self, "normal", checked("normal", self.normal, (n, 3), np.float32))
        object.__setattr__(self, "albedo", checked("albedo", self.albedo, (n, 3), np.float32))
        object.__setattr__(self, "confidence", checked("confidence", self.confidence, (n,), np.float32))
        unit("normal", self.normal)


@dataclass(frozen=True, eq=False)
class Surface:
    """A triangle mesh: vertices (V, 3) world; faces (F, 3), counter-clockwise seen from outside."""

    vertices: Float
    faces: Int

    def __post_init__(self) -> None:
        object.__setattr__(self, "vertices", checked("vertices", self.vertices, (None, 3)))
        object.__setattr__(self, "faces", checked("faces", self.faces, (None, 3), np.int64))
        if not len(self.faces):
            raise ValueError("faces: wanted at least one, given none")
        if self.faces.min() < 0 or self.faces.max() >= len(self.vertices):
            raise ValueError(f"faces: wanted indices in 0..{len(self.vertices) - 1}, given {self.faces.min()}..{self.faces.max()}")


@dataclass(frozen=True)
class Law:
    """What the reflectance of all points of an object has in common (shading.py).

    sharpness  of the lobes
    grazing    change of the diffuse term when light or view graze, relative: negative under a glossy coat, positive on rough bodies
    bounce     diffuse reflectance in [0, 1] over albedo, which is in units of the photographs: strength of inter-reflection; 0 without
    microfacet lobes are distributions of microfacets instead of spherical Gaussians
    shadows    surfaces cast shadows on each other
    gleam      as bounce, of light that lobes take part in (gleam.py); 0 without
    """

    sharpness: tuple[float, ...]
    grazing: float = 0.0
    bounce: float = 0.0
    microfacet: bool = False
    shadows: bool = True
    gleam: float = 0.0


@dataclass(frozen=True, eq=False)
class Residual:
    """The neural residual of the reflectance (neural.py).

    share   (V,) 1 on the vertices that have one, 0 on the others
    code    (V, codes) what the network knows of a vertex
    layers  weights (out, in) and biases (out,), the last with one output
    """

    share: NDArray[np.float32]
    code: NDArray[np.float32]
    layers: tuple[tuple[NDArray[np.float32], NDArray[np.float32]], ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "share", checked("residual share", self.share, (None,), np.float32))
        object.__setattr__(self, "code", checked("residual code", self.code, (len(self.share), None), np.float32))
        layers, width = [], None
        for weight, bias in self.layers:
            weight = checked("residual weights", weight, (None, width), np.float32)
            width = len(weight)
            layers.append((weight, checked("residual biases", bias, (width,), np.float32)))
        if width != 1:
            raise ValueError(f"residual: wanted layers that end in one output, given {width or 'none'}")
        object.__setattr__(self, "layers", tuple(layers))


@dataclass(frozen=True, eq=False)
class Material:
    """Reflectance on the vertices of a surface.

    normal           (V, 3) refined shading normal, unit, world frame
    albedo           (V, 3) RGB
    specular_weight  (V, lobes) or (V, lobes, 3), non-negative
    sharpness        (lobes,) of exp(sharpness * (half . normal - 1)), positive
    confidence       (V,) in the normal (RELIABLE); 0 where no photograph saw the vertex
    grazing, bounce, microfacet, shadows, gleam  as in `Law`
    residual         of the reflectance, where albedo and lobes fit badly; None where there is none
    """

    normal: Float
    albedo: Float
    specular_weight: Float
    sharpness: Float
    confidence: Float
    grazing: float = 0.0
    bounce: float = 0.0
    microfacet: bool = False
    shadows: bool = True
    gleam: float = 0.0
    residual: Residual | None = None

    @property
    def law(self) -> Law:
        """What all vertices have in common."""
        return Law(tuple(self.sharpness.tolist()), self.grazing, self.bounce, self.microfacet, self.shadows, self.gleam)

    def __post_init__(self) -> None:
        n = len(self.albedo)
        object.__setattr__(self, "normal", checked("normal", self.normal, (n, 3)))
        object.__setattr__(self, "albedo", checked("albedo", self.albedo, (n, 3)))
        object.__setattr__(self, "sharpness", checked("sharpness", self.sharpness, (None,)))
        lobes = len(self.sharpness)
        weight_shape = (n, lobes, 3) if np.ndim(self.specular_weight) == 3 else (n, lobes)
        object.__setattr__(self, "specular_weight", checked("specular_weight", self.specular_weight, weight_shape))
        object.__setattr__(self, "confidence", checked("confidence", self.confidence, (n,)))
        unit("normal", self.normal)
        if (self.albedo < 0).any() or (self.specular_weight < 0).any():
            raise ValueError("material: wanted non-negative albedo and specular_weight, given a negative one")
        if self.residual is not None and len(self.residual.share) != n:
            raise ValueError(f"residual: wanted {n} vertices, given {len(self.residual.share)}")


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """What a reconstruction is: geometry, reflectance, lights, and the account of how it came about.

    views        names of all views of the capture (reconstructed from and held out), in the order of `lights`
    lights       of every view in `views`, including held-out photographs
    light_names  per view the numbers of its lights, counted from 1
    normal_maps  per view (height, width, 3) float32 world frame, NaN outside the mask
    own_normals  the same by the pixels alone, not drawn to the surface (view_normals.py), for textures; none where read from files
    metrics      time and memory per stage, residuals, status in words; plain JSON values
    settings     everything needed to run it again; plain JSON values
    """

    surface: Surface
    material: Material
    lights: Lights
    views: tuple[str, ...]
    light_names: tuple[tuple[int, ...], ...]
    normal_maps: tuple[NDArray[np.float32], ...]
    metrics: dict[str, Any] = field(default_factory=dict)
    settings: dict[str, Any] = field(default_factory=dict)
    own_normals: tuple[NDArray[np.float32], ...] = ()

    def __post_init__(self) -> None:
        if len(self.material.albedo) != len(self.surface.vertices):
            raise ValueError(f"material: wanted {len(self.surface.vertices)} vertices, given {len(self.material.albedo)}")
        for name in ("light_names", "normal_maps"):
            if len(getattr(self, name)) != len(self.views):
                raise ValueError(f"{name}: wanted one per view ({len(self.views)}), given {len(getattr(self, name))}")
        if len(self.lights.direction) != len(self.views):
            raise ValueError(f"lights: wanted one set per view ({len(self.views)}), given {len(self.lights.direction)}")


@dataclass(frozen=True, eq=False)
class SignedDistanceGrid:
    """Signed distance sampled on a grid, world units, negative inside: values[i, j, k] at origin + spacing * (i, j, k)."""

    values: NDArray[np.float32]
    origin: Float
    spacing: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "values", checked("signed distance", self.values, (None, None, None), np.float32))
        object.__setattr__(self, "origin", checked("origin", self.origin, (3,)))
        if not self.spacing > 0:
            raise ValueError(f"spacing: wanted a positive length, given {self.spacing}")


@dataclass(frozen=True, eq=False)
class Truth:
    """Ground truth of a capture, as far as it has one. A view that a mapping does not name has none of that kind.

    views      names of all views of the capture
    normals    by view name (height, width, 3) float32 unit, world frame, NaN outside the mask
    direction  by view name (lights, 3) unit, world frame, from the surface towards the light, in the order of all its lights
    intensity  by view name (lights, 3) RGB, positive, relative, as in the file
    surface    the true surface, world frame; None where the capture has none
    """

    views: tuple[str, ...]
    normals: Mapping[str, NDArray[np.float32]]
    direction: Mapping[str, Float]
    intensity: Mapping[str, Float]
    surface: Surface | None

    def __post_init__(self) -> None:
        for name, dtype, shape, finite in (
            ("normals", np.float32, (None, None, 3), False),
            ("direction", np.float64, (None, 3), True),
            ("intensity", np.float64, (None, 3), True),
        ):
            given: Mapping[str, Any] = getattr(self, name)
            unknown = sorted(set(given) - set(self.views))
            if unknown:
                raise ValueError(f"{name}: wanted views among {list(self.views)}, given {unknown}")
            arrays = {view: checked(f"{name} of {view}", array, shape, dtype, finite) for view, array in given.items()}
            object.__setattr__(self, name, MappingProxyType(arrays))
        for view, normals in self.normals.items():
            unit(f"normals of {view}", normals[np.isfinite(normals).all(-1)])
        for view, direction in self.direction.items():
            unit(f"direction of {view}", direction)
        if any((intensity <= 0).any() for intensity in self.intensity.values()):
            raise ValueError("intensity: wanted positive numbers, given one that is not")
