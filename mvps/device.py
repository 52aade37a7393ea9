"""The device that tensors are on, one for a whole reconstruction. Values (numpy) go in and out of the rooms; inside, tensors are made on
the device of those that a function was given.

Not on the device: ray casting (Embree), meshes (libigl), sparse factors and products (scipy).
"""

from __future__ import annotations

import torch

from mvps.scene import CaptureError

Device = torch.device


def chosen_device(name: str) -> Device:
    """The device for auto, cpu or cuda; auto is CUDA where there is one. CaptureError where cuda is asked for and not there."""
    if name == "cpu" or not torch.cuda.is_available():
        if name == "cuda":
            raise CaptureError("--device: wanted a CUDA device, given a machine on which torch finds none; use --device cpu or auto")
        return torch.device("cpu")
    # torch loads its CUDA linear algebra when first used, and fails where two threads are the first (pytorch issue 90613).
    torch.linalg.inv(torch.eye(1, device="cuda"))
    return torch.device("cuda")
