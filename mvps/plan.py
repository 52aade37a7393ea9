"""What Stage II does when: its rounds by preset, and which parts of the method take part.

Lengths of rounds are in pixels. Ablations leave parts out; nothing else does.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mvps.joint.refine import RefineSettings, RoundSettings
from mvps.material import LARGEST, Model
from mvps.scene import Law

STILL_PIXELS = 0.05
"""Mean move of the vertices that is still to come after a round, above which it is done again: less is within the least error of
where views agree (POSITION_FLOOR_PIXELS in mvps/joint/refine.py)."""


@dataclass(frozen=True)
class Parts:
    """The parts of the method that take part.

    model        all that the reflectance may have
    microfacet   lobes are distributions of microfacets (shading.py)
    shadows      cast shadows are traced
    one_rig      lights that all views share are looked for
    free_lights  lights are refined after their first estimate
    moves        vertices move in the last rounds, to where views agree; without, the surface is Stage I's (`draft`: the hull)
    edges        of the meshes, over those of the preset: a budget
    """

    model: Model = LARGEST
    microfacet: bool = False
    shadows: bool = True
    one_rig: bool = True
    free_lights: bool = True
    moves: bool = True
    edges: float = 1.0

    def law(self) -> Law:
        """The image model to start with."""
        return Law(self.model.sharpness, microfacet=self.microfacet, shadows=self.shadows)

    def of(self, plan: RefineSettings) -> RefineSettings:
        """The plan with these parts alone."""
        rounds = tuple(
            replace(
                one,
                edge=one.edge * self.edges,
                # The same curvature, seen over a longer edge.
                crease=one.crease * self.edges,
                fusions=one.fusions if self.moves or plan.for_field else 0,
            )
            for one in plan.rounds
        )
        return replace(plan, rounds=rounds, free_lights=plan.free_lights and self.free_lights, model=self.model)


def first_pass(free_lights: bool, final: bool) -> RefineSettings:
    """Rounds on the hull: lights and normals good enough for Stage I, or all there is (final). Sweeps reach as far as a hull bulges over
    shallow hollows."""
    rounds = (RoundSettings(3.0, 4.0, 0.5, photometric=False), RoundSettings(3.0, 2.0, 0.4))
    return RefineSettings(rounds, free_lights, free_lights, final=final, for_field=not final, half=True, detail=final)


EASED_FUSIONS = 2
"""Where photographs abound: a third one moves bunny and armadillo by two thousandths of a pixel at most (docs/findings/stage_one.md)."""

COARSE = RoundSettings(2.0, 2.4, 0.4, still=STILL_PIXELS, carving=True)
"""A round on Stage I's surface; its sweep reaches as far as Stage I is off in hollows."""


def carving_pass(free_lights: bool, eased: bool = False) -> RefineSettings:
    """What comes after Stage I: lights and normals on its surface, and hollows dug as deep as photographs tell, until vertices lie still
    where the model fits; where it does not, Stage I has a turn first. eased: photographs abound and the model fits, so less of each does
    (docs/findings/stage_one.md)."""
    coarse = replace(COARSE, edge=2.5, fusions=EASED_FUSIONS) if eased else COARSE
    return RefineSettings((coarse,), free_lights, free_lights, half=True, eased=eased)


def once(plan: RefineSettings) -> RefineSettings:
    """The plan, its rounds done once each however far vertices still move."""
    return replace(plan, rounds=tuple(replace(one, still=np.inf) for one in plan.rounds))


def last_pass(preset: str, free_lights: bool, far: bool, before: list[dict[str, float]], eased: bool = False) -> RefineSettings:
    """Rounds after Stage I; sweeps reach as far as Stage I may be off. far: photographs have farther to pull the surface, because Stage I
    saw them at half their size, or had nothing but vertices' normals to go by, of views with fewer lights than tell a normal. before: what
    the rounds before came to. eased: as in `carving_pass`."""
    first = RoundSettings(2.0, 1.2, 0.3, crease=0.1, still=STILL_PIXELS)
    rounds: tuple[RoundSettings, ...] = {
        "standard": (first, replace(first, for_detail=True)),
        "fine": (first, replace(first, edge=1.0)),
    }[preset]
    if far:
        rounds = (COARSE, *rounds)
    if eased:
        rounds = tuple(replace(one, fusions=EASED_FUSIONS) for one in rounds)
    return RefineSettings(rounds, free_lights, free_lights, final=True, in_full=True, goes_on=before[-1]["goes_on"])
