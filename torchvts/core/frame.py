"""What the blocks of the online path hand to each other: a frame and its solution."""

from typing import NamedTuple

import torch
from torch import Tensor


class Frame(NamedTuple):
    """A batch of compensated images.

    Attributes:
        image: (B, 3, H, W), compensated, without a smooth change of the light where the pipeline divides by it.
        weight: (B, 1, H, W) in [0, 1], how surely the skin has moved.
        noise_std: (B, 3), noise of each frame's compensated image; None where the model of normals does not ask for it.
    """

    image: Tensor
    weight: Tensor
    noise_std: Tensor | None


class Solution(NamedTuple):
    """gradient (B, 2, H, W), mm per mm, times the weight; depth_mm (B, 1, H, W), from the undeformed skin."""

    gradient: Tensor
    depth_mm: Tensor


class DepthOutput(NamedTuple):
    """Depth, its slopes and two masks of each frame.

    Attributes:
        depth_mm: (B, 1, H, W), positive where the skin is pressed in.
        gradient: (B, 2, H, W), mm per mm.
        normal: (B, 3, H, W), unit.
        contact: (B, 1, H, W) bool, where the object touches the skin.
        deformed: (B, 1, H, W) bool, where the skin has moved: the contact and the skin that hangs free around it.
    """

    depth_mm: Tensor
    gradient: Tensor
    normal: Tensor
    contact: Tensor
    deformed: Tensor


def as_factor(mask: Tensor, like: Tensor) -> Tensor:
    """A bool mask as zeros and ones of the dtype of ``like``."""
    return mask.to(torch.uint8).to(like.dtype)  # four times as fast as straight from bool


def undeformed_output(frame: Frame) -> DepthOutput:
    """The output for frames without deformed skin: depth zero, normals towards the camera."""
    like = frame.image
    normal = torch.zeros_like(like)
    normal[:, 2] = 1.0
    nowhere = torch.zeros_like(like[:, 0:1], dtype=torch.bool)
    return DepthOutput(torch.zeros_like(like[:, 0:1]), torch.zeros_like(like[:, 0:2]), normal, nowhere, nowhere.clone())


def joined(outputs: list[DepthOutput]) -> DepthOutput:
    """The outputs of batches as that of one."""
    return DepthOutput(
        torch.cat([out.depth_mm for out in outputs]),
        torch.cat([out.gradient for out in outputs]),
        torch.cat([out.normal for out in outputs]),
        torch.cat([out.contact for out in outputs]),
        torch.cat([out.deformed for out in outputs]),
    )


def batch_like(one: DepthOutput, count: int) -> DepthOutput:
    """Memory for the output of that many frames; its values are not set."""
    return DepthOutput(
        _empty(one.depth_mm, count),
        _empty(one.gradient, count),
        _empty(one.normal, count),
        _empty(one.contact, count),
        _empty(one.deformed, count),
    )


def _empty(like: Tensor, count: int) -> Tensor:
    return torch.empty_like(like.expand(count, -1, -1, -1), memory_format=torch.contiguous_format)


def write_frame(out: DepthOutput, i: int, one: DepthOutput) -> None:
    """Write the output of one frame into that of a batch."""
    out.depth_mm[i].copy_(one.depth_mm[0])
    out.gradient[i].copy_(one.gradient[0])
    out.normal[i].copy_(one.normal[0])
    out.contact[i].copy_(one.contact[0])
    out.deformed[i].copy_(one.deformed[0])
