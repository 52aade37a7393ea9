"""Lights without calibration, from a rough shape.

Lambert's law without shadow, for pixel p under light l:   I_pl = b_p . s_l,   b = albedo * normal,   s = intensity * direction.
A robust rank-3 factorisation gives b and s up to an invertible 3 x 3 matrix A (Hayakawa 1994):

    b = A b',   s = A^-T s',   and   n_p x (A b'_p) = 0     for a rough shape's normals n_p,

nine homogeneous linear equations in A whose null vector, the smallest eigenvector of a 9 x 9 matrix, starts Gauss-Newton steps on
sum_p rho(|A b'_p / |A b'_p| - n_p|). rho redescends and its scale shrinks (graduated non-convexity, Blake and Zisserman 1987), because
a hull's normals are exact near the silhouettes and far off in concavities.

Where all views are under the same lights (one rig), all pixels of all views are factorised together. That is decided by the data: pooled,
the variance that the factors leave must not double against separate factorisations, and what other views say of a light must be what a
view says itself (correlation.py): of metals, and of four lights, factors leave as much either way. Of a view that shows three flat sides
three factors explain anything, and its normals fix no A: from most views so, one rig is believed. A is fixed where the second eigenvalue of
the 9 x 9 matrix over its inliers, at the solved A, is above what the last scale of rho lets pass; where it is not, albedo a_p and s_l are
solved in turn in

    I_pl = a_p (n_p . s_l)+     for the rough shape's normals as they are.

So they are where views then say more alike of the same places (between_views.py): the hull of few views has wrong normals all over, which
fix A wrongly, and factors of samples of which many are in shadow, or highlights, may be no factors of the images. Where factors leave much,
Lambert's law explains little whatever the albedo is, and wrong normals draw lights away with every sweep: there what views say tells how
many there are, none among them, which is plain least squares with one albedo.

Factors know no frame. Whether a rig stands still with the camera or in the world, while the camera moves, is told by which of the two
leaves less under the rough shape's normals and one albedo at every vertex (sharing.py). Nor do factors find lights that most pixels of a
view turn away from (of lamps all around, half are behind the object), for what is not lit counts as missing. So a rig that so explains the
views is believed too. Its lights, and those of one that stands still in the world, are the ones of the equation above.

Metals have no diffuse body, and the factors say nothing: where highlights explain the images better than Lambert's law does, the lights
are those by correlation (correlation.py).

Views with fewer than MINIMUM_LIGHTS lights cannot be factorised; there the lights are the least-squares solution of I_pl = n_p . s_l
for the rough shape's normals, one albedo for the whole object (other albedos are outliers), of all views together where they share lights;
other views beside them are solved without them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from mvps.between_views import BODY, CLEARLY_NEARER, nearer, nearest, said
from mvps.cores import on_cores
from mvps.correlation import alike_in_all_views, glossy_lights, is_glossy, lamps_of_a_glossy_surface
from mvps.mesh import lengths, normalise, vertex_normals
from mvps.pixel_samples import BRIGHT_QUANTILE, PIXELS_PER_VIEW, SHADOWED, PixelSamples, colour_ratios, in_frame, pixel_samples, pooled
from mvps.scene import Bool, Capture, CaptureError, Float, Lights, Surface
from mvps.sharing import shared_frame, vertex_samples
from mvps.visibility import RayCaster, ray_caster
from solvers.low_rank import Factorisation, factorise, of_length_one, robust_weights, solve_rows

MINIMUM_LIGHTS = 4
"""A rank-3 factorisation of three or fewer columns is exact for any data and so says nothing."""

POOLED_VARIANCE_RATIO = 2.0
"""One rig is believed while pooling the views adds less variance than single views leave."""

ROUGH_NORMAL, FINE_NORMAL = 0.3, 0.05
"""Scale of the robust angle, radians, from first to last sweep: the error of a visual hull's normals where it bulges over a concavity,
down to the error of Lambertian normals on glossy objects. Between them the pixels where the hull is not the surface are outvoted."""

AMBIGUITY_SWEEPS = 20

ALTERNATIONS = (0, 1, 2, 5, 10, 20)
"""Sweeps of albedo and lights in turn after which views are asked of them."""

PIXELS_FOR_THE_OTHER = 4000
"""Of all views, from which a rig under the rough shape's normals is found that is held against that of the factors."""


@dataclass(frozen=True)
class Calibration:
    """Lights of all views, and how well the factorisation explains the images.

    residual: relative RMS that three factors leave; fourth_singular_value: over the first one. Both are 0.05 to 0.15 on matte and glossy
    objects, above 0.25 where there is no diffuse body, and NaN where there are too few lights to factorise. metallic: the lights are those
    by correlation (correlation.py), and photometric stereo by Lambert's law would say nothing.
    assumed: one rig was believed because single views tell nothing of their lights; under_normals: of some or all lights the rough shape's
    normals did not fix the ambiguity, or factors were not believed, so that these are the lights under the normals as they are.
    """

    lights: Lights
    residual: float
    fourth_singular_value: float
    metallic: bool = False
    assumed: bool = False
    under_normals: bool = False

    def words(self) -> str:
        """How the lights were found."""
        kind = "one rig for all views" if self.lights.one_rig else "lights of every view on their own"
        kind += ", which stands still while the camera moves" if self.lights.fixed else ""
        if math.isnan(self.residual):
            return f"{kind}, from the rough shape's normals"
        kind += ", which do not tell them one by one" if self.assumed else ""
        kind += ", from the rough shape's normals where factors are not believed" if self.under_normals else ""
        return f"{kind}; three factors leave {100 * self.residual:.1f} % of the images"


def _gram(pseudo: Float, normal: Float, weight: Float) -> Float:
    """(9, 9) of the quadratic form sum_p weight_p |n_p x (A b_p)|^2 in A."""
    # n x (A b) = 0 has the rows [n]_x (x) b^T; their Gram matrix is sum_p (1 - n n^T) (x) b b^T.
    project_out = np.eye(3) - normal[:, :, None] * normal[:, None, :]
    outer = pseudo[:, :, None] * pseudo[:, None, :]
    gram: Float = np.einsum("p,pij,pkl->ikjl", weight, project_out, outer, optimize=True).reshape(9, 9)
    return gram


def _null_vector(pseudo: Float, normal: Float, weight: Float) -> Float:
    """(3, 3) A that minimises sum_p weight_p |n_p x (A b_p)|^2: the algebraic start."""
    A: Float = np.linalg.eigh(_gram(pseudo, normal, weight))[1][:, 0].reshape(3, 3)
    return A * (1.0 if ((pseudo @ A.T * normal).sum(1) * weight).sum() > 0 else -1.0)


def _inliers(residual: Float, weight: Float, scale: float) -> Float:
    """(n,) weights of residuals (n, 3) by rho of Geman and McClure 1985 at `scale` radians."""
    robust: Float = weight / (1 + (residual**2).sum(1) / scale**2) ** 2
    return robust


def _angle_step(A: Float, pseudo: Float, normal: Float, weight: Float, scale: float) -> Float:
    """One Gauss-Newton step on sum_p weight_p rho(|A b_p / |A b_p| - n_p|) at `scale` radians."""
    mapped = pseudo @ A.T
    length = np.maximum(np.linalg.norm(mapped, axis=1, keepdims=True), 1e-12)
    unit = mapped / length
    residual = unit - normal
    robust = _inliers(residual, weight, scale)
    # d unit = (1 - unit unit^T) / length dA b
    project_out = (np.eye(3) - unit[:, :, None] * unit[:, None, :]) / length[:, :, None]
    jacobian = (project_out[:, :, :, None] * pseudo[:, None, None, :]).reshape(-1, 3, 9)
    hessian = np.einsum("p,pij,pik->jk", robust, jacobian, jacobian, optimize=True)
    gradient = np.einsum("p,pij,pi->j", robust, jacobian, residual, optimize=True)
    # The scale of A is free: a whisper of damping keeps the step from using it.
    hessian += 1e-9 * np.trace(hessian) * np.eye(9)
    stepped: Float = A - np.linalg.solve(hessian, gradient).reshape(3, 3)
    return stepped


def solve_ambiguity(pseudo: Float, normal: Float, weight: Float) -> Float:
    """(3, 3) A with A pseudo_p parallel to normal_p for most pixels; pseudo, normal (n, 3), weight (n,). |det A| = 1.

    Raises numpy.linalg.LinAlgError where the pixels' normals span no volume.
    """
    pseudo = pseudo / max(float(np.linalg.norm(pseudo, axis=1).mean()), 1e-300)
    A = _null_vector(pseudo, normal, weight)
    for scale in np.geomspace(ROUGH_NORMAL, FINE_NORMAL, AMBIGUITY_SWEEPS):
        determinant = np.linalg.det(A)
        if not np.isfinite(A).all() or abs(determinant) < 1e-9 * np.abs(A).max() ** 3:
            raise np.linalg.LinAlgError("the normals of the rough shape span no volume, so the lights' ambiguity cannot be fixed")
        A = _angle_step(A / np.cbrt(abs(determinant)), pseudo, normal, weight, float(scale))
    unimodular: Float = A / np.cbrt(abs(np.linalg.det(A)))
    return unimodular


def _fixed(A: Float, pseudo: Float, normal: Float, weight: Float) -> bool:
    """Whether normals (n, 3) fix A: whether no matrix at right angles to it puts most pixels within FINE_NORMAL of them too."""
    unit = normalise(pseudo @ A.T)
    inliers = _inliers(unit - normal, weight, FINE_NORMAL)
    return bool(np.linalg.eigvalsh(_gram(unit, normal, inliers))[1] > FINE_NORMAL**2 * inliers.sum())


def _ambiguity(factors: Factorisation, samples: list[PixelSamples]) -> Float | None:
    """(3, 3) A by the normals of the rough shape, None where they do not fix it."""
    normal, weight = np.concatenate([s.normal for s in samples]), factors.weight.mean(1).astype(np.float64)
    try:
        A = solve_ambiguity(factors.left, normal, weight)
    except np.linalg.LinAlgError:
        return None
    return A if _fixed(A, factors.left, normal, weight) else None


def _mostly_fixed(separate: list[Factorisation], samples: list[PixelSamples]) -> bool:
    """Whether most views' own normals fix A."""
    return 2 * sum(A is not None for A in on_cores(lambda f, s: _ambiguity(f, [s]), separate, samples)) > len(samples)


def _by_factors(factors: Factorisation, samples: list[PixelSamples]) -> Float | None:
    """(lights, 3) intensity times direction in the frame of the samples' normals, None where these do not fix the ambiguity."""
    A = _ambiguity(factors, samples)
    if A is None:
        return None
    return _of_median_albedo(factors.right @ np.linalg.inv(A), np.linalg.norm(factors.left @ A.T, axis=1), samples)


def _of_median_albedo(lights: Float, albedo: Float, samples: list[PixelSamples]) -> Float:
    """Lights (lights, 3) for albedo (n,) over bright levels, scaled so that those of separately solved views share one scale: the median
    albedo is the unit."""
    scaled: Float = lights * np.median(albedo * np.concatenate([s.bright for s in samples]))
    return without_gaps(scaled)


def _under_normals(samples: list[PixelSamples]) -> list[Float]:
    """(lights, 3) intensity times direction in the frame of the samples' normals, for these as they are: albedo and lights in turn, after
    each number of sweeps of ALTERNATIONS."""
    of = pooled(samples)
    known, normal, noise = of.known, of.normal, of.noise
    # Where fewer lights than the brightest fifth reach a pixel its bright level is none.
    image, level = of_length_one(of.image, known)
    if np.linalg.eigvalsh(normal.T @ normal)[0] < FINE_NORMAL**2 * len(normal):
        raise CaptureError(
            "lights: wanted a rough shape whose normals point many ways, given one where they all lie in one plane; use more views or"
            " --calibrated-lights"
        )
    lights, albedo = solve_rows(image.T, known.T.astype(np.float64), normal), np.ones(len(image))
    found = [_of_median_albedo(lights, level, samples)]
    for sweep in range(1, ALTERNATIONS[-1] + 1):
        shading = np.maximum(normal @ lights.T, 0)
        lit = known & (shading > 0)
        weight = robust_weights(image - albedo[:, None] * shading, lit, noise)
        albedo = (weight * image * shading).sum(1) / np.maximum((weight * shading**2).sum(1), np.finfo(float).tiny)
        weight = robust_weights((image - albedo[:, None] * shading).T, lit.T, noise)
        lights = solve_rows(image.T, weight, albedo[:, None] * normal)
        if sweep in ALTERNATIONS:
            found.append(_of_median_albedo(lights, albedo * level, samples))
    return found


def without_gaps(scaled: Float) -> Float:
    """(lights, 3) in which lights that no sample speaks of stand at the camera, with the median intensity (one where it is none's):
    something finite that nothing weighs."""
    length = np.linalg.norm(scaled, axis=1)
    known = length > 1e-9 * np.nanmax(length, initial=0)
    usual = np.median(length[known]) if known.any() else 1.0
    return np.where(known[:, None], scaled, np.array([0.0, 0.0, -1.0]) * usual)


def _from_normals(sample: PixelSamples) -> Float:
    """(lights, 3) least-squares lights for the rough shape's normals and one albedo: the case of few lights."""
    # A pixel's own bright level says nothing of its albedo where few lights made it: radiance itself is used.
    absolute = sample.absolute
    unsaturated = sample.known | (sample.image <= SHADOWED)
    unsaturated &= sample.known.any(0)
    lit = (unsaturated & (absolute > SHADOWED * np.quantile(absolute, BRIGHT_QUANTILE, axis=0))).astype(np.float64)
    lights = solve_rows(absolute.T, lit.T, sample.normal)
    for _ in range(AMBIGUITY_SWEEPS):
        residual = absolute - sample.normal @ lights.T
        weights = robust_weights(residual.T, lit.T, sample.noise * float(np.median(sample.bright)))
        lights = solve_rows(absolute.T, weights, sample.normal)
    return without_gaps(lights)


def normalised(directions: list[Float], intensities: list[Float], one_rig: bool, fixed: bool = False) -> Lights:
    """Lights with intensities scaled to a mean of one over all lights and channels."""
    mean = float(np.mean(np.concatenate(intensities)))
    return Lights(tuple(directions), tuple(e / mean for e in intensities), one_rig, fixed)


def uncalibrated_lights(capture: Capture, surface: Surface, seed: int, may_share: bool = True) -> Calibration:
    """Directions and intensities of all lights from the images and a rough surface's normals (module docstring); may_share: one rig is
    tried."""
    counts = {len(view.lights) for view in capture.views}
    if min(counts) < MINIMUM_LIGHTS <= max(counts):
        return _of_unequal(capture, surface, seed, may_share)
    generator = np.random.default_rng(seed)
    caster, normal = ray_caster(surface), vertex_normals(surface)
    samples = [pixel_samples(view, caster, normal, generator) for view in capture.views]
    may_share &= len(capture.views) > 1 and len({view.lights for view in capture.views}) == 1
    if min(counts) < MINIMUM_LIGHTS:
        frame = shared_frame(capture, caster, np.random.default_rng(seed)) if may_share else None
        if frame is not None:
            rig = _from_normals(pooled(in_frame(samples, capture, frame)))
            lights = _assemble(capture, [rig] * len(samples), True, frame == "world")
        else:
            lights = _assemble(capture, [_from_normals(sample) for sample in samples], False)
        return Calibration(lights, float("nan"), float("nan"))
    separate = on_cores(lambda s: factorise(s.image, s.known, 3, floor=s.noise), samples)
    residual = float(np.sqrt(np.mean([f.residual**2 for f in separate])))
    fourth = float(np.mean([f.singular_values[3] for f in separate]))
    if may_share:
        found = _one_rig(capture, caster, samples, separate, residual, generator, seed)
        if found is not None:
            return found
    if is_glossy([s.highlights for s in samples], [s.normal for s in samples], generator):
        lamps = _glossy_lamps(capture, samples) if may_share else None
        if lamps is not None:
            return Calibration(_assemble(capture, [lamps] * len(samples), True, fixed=True), residual, fourth, True)
        scaled = [glossy_lights(s.highlights, s.normal) for s in samples]
        return Calibration(_assemble(capture, scaled, False), residual, fourth, True)
    by_factors = [_by_factors(f, [s]) for f, s in zip(separate, samples, strict=True)]
    scaled, under_normals = _believed(capture, caster, samples, by_factors, residual, False, seed)
    return Calibration(_assemble(capture, scaled, False), residual, fourth, under_normals=under_normals)


def _of_unequal(capture: Capture, surface: Surface, seed: int, may_share: bool) -> Calibration:
    """Where some views have fewer than MINIMUM_LIGHTS lights: of the others as if these were not there, of these by the rough shape's
    normals, as strong over the others as they are where both are found so."""
    enough = [view for view in capture.views if len(view.lights) >= MINIMUM_LIGHTS]
    found = uncalibrated_lights(Capture(capture.name, tuple(enough)), surface, seed, may_share)
    generator, caster, normal = np.random.default_rng(seed), ray_caster(surface), vertex_normals(surface)
    own = {view.name: _from_normals(pixel_samples(view, caster, normal, generator)) for view in capture.views}
    stronger = [e.mean(1) / lengths(own[view.name]) for view, e in zip(enough, found.lights.intensity, strict=True)]
    factor = float(np.median(np.concatenate(stronger)))
    names = [view.name for view in enough]
    directions, intensities = [], []
    for view in capture.views:
        if view.name in names:
            at = names.index(view.name)
            directions.append(found.lights.direction[at])
            intensities.append(found.lights.intensity[at])
        else:
            directions.append(normalise(own[view.name]) @ view.camera.rotation)
            intensities.append(factor * lengths(own[view.name])[:, None] * colour_ratios(view))
    return replace(found, lights=normalised(directions, intensities, False), under_normals=True)


def _one_rig(
    capture: Capture,
    caster: RayCaster,
    samples: list[PixelSamples],
    separate: list[Factorisation],
    residual: float,
    generator: np.random.Generator,
    seed: int,
) -> Calibration | None:
    """Lights that all views share, None where they share none; residual: what separate factors leave."""
    of_all = pooled(samples)
    together = factorise(of_all.image, of_all.known, 3, floor=of_all.noise)
    left, fourth = together.residual, float(together.singular_values[3])
    metallic = is_glossy([of_all.highlights], [of_all.normal], generator)
    told = alike_in_all_views([s.highlights for s in samples], [s.normal for s in samples], metallic)
    alike = told is not False and together.residual**2 < POOLED_VARIANCE_RATIO * residual**2
    lamps = _glossy_lamps(capture, samples) if metallic else None
    if lamps is not None:
        return Calibration(_assemble(capture, [lamps] * len(samples), True, fixed=True), left, fourth, True)
    # Highlights hide what normals tell.
    frame = None if metallic else shared_frame(capture, caster, np.random.default_rng(seed))
    flat = told is not False and not alike and frame is None and not _mostly_fixed(separate, samples)
    if not (alike or frame or flat):
        return None
    if metallic:
        rig = glossy_lights(of_all.highlights, of_all.normal)
        return Calibration(_assemble(capture, [rig] * len(samples), True), left, fourth, metallic, assumed=flat)
    if frame == "world":
        rig = _under_normals(in_frame(samples, capture, frame))[-1]
        return Calibration(_assemble(capture, [rig] * len(samples), True, fixed=True), left, fourth, under_normals=True)
    by_factors = _by_factors(together, samples) if alike or flat else None
    scaled, under_normals = _believed(capture, caster, samples, [by_factors] * len(samples), left, True, seed)
    return Calibration(_assemble(capture, scaled, True), left, fourth, assumed=flat, under_normals=under_normals)


def _believed(
    capture: Capture,
    caster: RayCaster,
    samples: list[PixelSamples],
    by_factors: list[Float | None],
    left: float,
    one_rig: bool,
    seed: int,
) -> tuple[list[Float], bool]:
    """Per view the lights (lights, 3) by factors, None where these do not fix the ambiguity, or under the rough shape's normals, by what
    views say of the same places; and whether any are the latter. left: what factors leave of the photographs."""
    try:
        by_sweeps = _by_sweeps(samples, one_rig, by_factors[0] is not None)
    except CaptureError:
        # Normals in a plane say nothing of lights across it.
        fixed = [lights for lights in by_factors if lights is not None]
        if len(fixed) < len(samples):
            raise
        return fixed, False
    of = vertex_samples(capture, caster, np.random.default_rng(seed))

    def said_under(lights: list[Float]) -> list[Float]:
        return on_cores(lambda part, s, view: said(part, s, view.camera, view.scale), of, lights, capture.views)

    lambertian = left < BODY
    asked = by_sweeps[-1:] if lambertian else by_sweeps
    under = [said_under(lights) for lights in asked]
    best = nearest(of, under, one_rig)
    other = asked[best]
    first = [o if lights is None else lights for lights, o in zip(by_factors, other, strict=True)]
    chosen = nearer(of, said_under(first), under[best], one_rig, CLEARLY_NEARER if lambertian else 1.0)
    scaled = [o if is_other else lights for lights, o, is_other in zip(first, other, chosen, strict=True)]
    return scaled, any(chosen) or any(lights is None for lights in by_factors)


def _by_sweeps(samples: list[PixelSamples], one_rig: bool, few: bool) -> list[list[Float]]:
    """Every view's lights (lights, 3) under the rough shape's normals, after each number of sweeps; few: a rig's by some of the pixels."""
    if one_rig:
        most = max(PIXELS_FOR_THE_OTHER // len(samples), 1) if few else PIXELS_PER_VIEW
        return [[rig] * len(samples) for rig in _under_normals([s.part(most) for s in samples])]
    return [list(of_sweep) for of_sweep in zip(*on_cores(lambda s: _under_normals([s]), samples), strict=True)]


def _glossy_lamps(capture: Capture, samples: list[PixelSamples]) -> Float | None:
    """Lights of a glossy surface that stand still in the world, where they do (correlation.py)."""
    rotations = [view.camera.rotation for view in capture.views]
    return lamps_of_a_glossy_surface([s.highlights for s in samples], [s.normal for s in samples], rotations)


def is_metallic(capture: Capture, surface: Surface, seed: int) -> bool:
    """Whether highlights explain the photographs better than Lambert's law does, every view for itself, under a rough surface's normals."""
    generator = np.random.default_rng(seed)
    caster, normal = ray_caster(surface), vertex_normals(surface)
    samples = [pixel_samples(view, caster, normal, generator) for view in capture.views]
    return is_glossy([s.highlights for s in samples], [s.normal for s in samples], generator)


def _of_shown(ratios: Float, shown: Bool) -> Float:
    """(lights, 3) mean over the views (views, lights, 3) that show a light (views, lights); 1 where none does."""
    if shown.all():
        mean: Float = ratios.mean(0)
        return mean
    count = shown.sum(0)[:, None]
    return np.where(count > 0, np.where(shown[..., None], ratios, 0).sum(0) / np.maximum(count, 1), 1.0)


def _assemble(capture: Capture, scaled: list[Float], one_rig: bool, fixed: bool = False) -> Lights:
    """Lights of intensity times direction (lights, 3) of every view, in the cameras' frames; fixed: in the world's."""
    ratios = on_cores(colour_ratios, capture.views)
    if one_rig:
        ratios = [_of_shown(np.array(ratios), np.array([view.shown for view in capture.views]))] * len(ratios)
    strength = [np.linalg.norm(s, axis=1, keepdims=True) for s in scaled]
    unit = [s / length for s, length in zip(scaled, strength, strict=True)]
    directions = unit if fixed else [d @ view.camera.rotation for d, view in zip(unit, capture.views, strict=True)]
    return normalised(directions, [length * r for length, r in zip(strength, ratios, strict=True)], one_rig, fixed)
