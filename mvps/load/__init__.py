"""A folder -> Capture, and the ground truth beside it; every complaint about a capture comes from here."""

from mvps.load.diligent import read_capture, with_mask
from mvps.load.environment import read_environment
from mvps.load.truth import read_calibrated_lights, read_truth

__all__ = ["read_calibrated_lights", "read_capture", "read_environment", "read_truth", "with_mask"]
