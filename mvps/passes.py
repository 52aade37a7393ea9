"""Single passes of the two stages, under the progress bar."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

from mvps.progress import Progress
from mvps.scene import Capture, Law, Lights, NormalMap

if TYPE_CHECKING:
    from mvps.joint.refine import Refined, RefineSettings
    from mvps.occupancy import Occupancy, OccupancySettings
    from mvps.reconstruct import Settings
    from mvps.scene import SignedDistanceGrid, Surface


class Begun(NamedTuple):
    """What Stage II starts with: the hull, as a grid too, lights, and the views' photometric stereo under them."""

    grid: SignedDistanceGrid
    surface: Surface
    lights: Lights
    maps: tuple[NormalMap, ...]
    law: Law


def stage_one(field: Occupancy, maps: tuple[NormalMap, ...], plan: OccupancySettings, progress: Progress, words: str = "") -> Surface:
    """The occupancy field under the progress bar; words: its status."""
    with progress.stage("occupancy field", total=plan.steps) as stage:
        stage.status(words)
        return field.trained(maps, plan, lambda _, loss: stage.advance(1, loss=loss))


def stage_two(
    name: str,
    capture: Capture,
    surface: Surface,
    of: Begun | Refined,
    plan: RefineSettings,
    settings: Settings,
    progress: Progress,
    carried: tuple[Surface, Any] | None = None,
) -> Refined:
    """Rounds of Stage II under the progress bar, from a surface and the lights, normal maps and image model `of` what came before."""
    from mvps.device import chosen_device
    from mvps.joint.refine import refine

    with progress.stage(name, total=len(plan.rounds)) as stage:

        def on_round(_: int, changes: dict[str, float]) -> None:
            stage.advance(1, **{k: v for k, v in changes.items() if k in ("residual", "light_change_deg", "vertex_change_px")})

        device = chosen_device(settings.device)
        refined = refine(capture, surface, of.lights, of.maps, of.law, plan, settings.seed, device, on_round, carried)
        stage.status(refined.status)
    return refined
