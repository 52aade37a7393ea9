"""How far a reconstruction is from the truth, and from photographs it has not seen: our measures, and those of the papers of the field.

ours.py        first hits, exact distances to triangles, normals, confidence
lights.py      lights; which views and photographs are held out
images.py      renderings against photographs; PSNR, SSIM, LPIPS
points.py      point sets and meshes: nearest neighbours, samples, ICP, curvature
protocols.py   SuperNormal, MVSCPS, PS-NeRF, MVPSNet and RNb-NeuS as their papers and programs measure
psnerf.py      what PS-NeRF measures on pixels
"""

from mvps.measures.images import Perceptual, perceptual_distance, photograph_errors, psnr_db, similarity
from mvps.measures.lights import (
    Light,
    Photograph,
    by_photograph,
    held_out_photographs,
    held_out_views,
    light_errors,
    true_lights,
    unseen_views,
)
from mvps.measures.ours import (
    confidence_errors,
    distance_to,
    evaluate,
    first_hit_points,
    mesh_normal_errors,
    mesh_normals,
    normal_errors,
    object_centre,
    seen_from_outside,
    surface_errors,
)
from mvps.measures.protocols import (
    figures_of,
    low_visibility,
    mvpsnet_errors,
    mvscps_errors,
    psnerf_chamfer,
    rnbneus_errors,
    rnbneus_normal_error,
    supernormal_errors,
    unit_box,
)
from mvps.measures.psnerf import psnerf_errors, psnerf_image_errors, psnerf_light_errors, psnerf_normal_errors
from mvps.mesh import angles_deg

__all__ = [
    "Light",
    "Perceptual",
    "Photograph",
    "angles_deg",
    "by_photograph",
    "confidence_errors",
    "distance_to",
    "evaluate",
    "figures_of",
    "first_hit_points",
    "held_out_photographs",
    "held_out_views",
    "light_errors",
    "low_visibility",
    "mesh_normal_errors",
    "mesh_normals",
    "mvpsnet_errors",
    "mvscps_errors",
    "normal_errors",
    "object_centre",
    "perceptual_distance",
    "photograph_errors",
    "psnerf_chamfer",
    "psnerf_errors",
    "psnerf_image_errors",
    "psnerf_light_errors",
    "psnerf_normal_errors",
    "psnr_db",
    "rnbneus_errors",
    "rnbneus_normal_error",
    "seen_from_outside",
    "similarity",
    "supernormal_errors",
    "surface_errors",
    "true_lights",
    "unit_box",
    "unseen_views",
]
