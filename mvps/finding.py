"""What a check says about a capture."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Finding:
    """Something wrong with a capture that was found in the data, never in ground truth.

    about    what it concerns: "photograph", "view", "mask", "pose", "radiometry" or "lights"
    where    the view, photograph or part, as a user would look for it: "view_03", "view_03/007", "all views"
    text     one sentence: what was seen, by which measure, and what was done about it
    mended   whether the reconstruction goes on without the fault (left out, corrected); if not, the result may suffer from it
    """

    about: str
    where: str
    text: str
    mended: bool
