"""A folder -> Capture, and the ground truth beside it; every complaint about a capture comes from here."""

from mvps.load.diligent import read_capture
from mvps.load.truth import read_calibrated_lights, read_truth

__all__ = ["read_calibrated_lights", "read_capture", "read_truth"]
