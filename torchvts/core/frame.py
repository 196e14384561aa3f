"""What the blocks of the online path hand to each other: a frame cut to the window around its deformed area, and its solution."""

from typing import Final, NamedTuple

import torch
from torch import Tensor, nn

from .checks import may_read
from .geometry import gradient_of_depth, normal_from_gradient


class Frame(NamedTuple):
    """A batch of compensated images and the window that holds all deformed skin.

    Attributes:
        compensated: (B, 3, H, W), the whole compensated image.
        deformed: (B, 1, H, W) bool, where the skin has moved.
        image: (B, 3, h, w), the window of ``compensated``.
        mask: (B, 1, h, w) bool, the window of ``deformed``.
        window: (top, left), the place of the window's first pixel.
        size: (H, W).
        noise_std: (B, 3), noise of each frame's compensated image; None where the model of normals does not ask for it.
    """

    compensated: Tensor
    deformed: Tensor
    image: Tensor
    mask: Tensor
    window: tuple[int, int]
    size: tuple[int, int]
    noise_std: Tensor | None


class Solution(NamedTuple):
    """gradient (B, 2, h, w) in the window, mm per mm; depth_mm (B, 1, H, W) of the whole image."""

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


class Masked(nn.Module):
    """A gradient (B, 2, h, w), zero outside of a mask, bool (B, 1, h, w)."""

    def forward(self, gradient: Tensor, mask: Tensor) -> Tensor:
        return gradient * as_factor(mask, gradient)


class MaskedGradient(nn.Module):
    """The gradient of depth (B, 1, h, w), (B, 2, h, w), zero outside of a mask, bool (B, 1, h, w).

    Args:
        mm_per_pixel: pixel pitch, mm.
    """

    def __init__(self, mm_per_pixel: float) -> None:
        super().__init__()
        self.mm_per_pixel = mm_per_pixel

    def forward(self, depth_mm: Tensor, mask: Tensor) -> Tensor:
        gradient = gradient_of_depth(depth_mm, self.mm_per_pixel)
        return gradient * as_factor(mask, gradient)


def in_window(frame: Frame, image: Tensor) -> Tensor:
    """The window's part (B, C, h, w) of (B, C, H, W)."""
    top, left = frame.window
    return image[:, :, top : top + frame.image.shape[2], left : left + frame.image.shape[3]]


def with_deformed(frame: Frame, image: Tensor, mask: Tensor) -> Frame:
    """The frame with another image and another deformed area in its window."""
    (top, left), (height, width) = frame.window, frame.size
    outside = [left, width - left - mask.shape[3], top, height - top - mask.shape[2]]
    return Frame(frame.compensated, nn.functional.pad(mask, outside), image, mask, frame.window, frame.size, frame.noise_std)


def with_noise(frame: Frame, noise_std: Tensor | None) -> Frame:
    """The frame with the noise of its compensated image, (B, 3)."""
    return Frame(frame.compensated, frame.deformed, frame.image, frame.mask, frame.window, frame.size, noise_std)


class Crop(nn.Module):
    """Cut a compensated image (B, 3, H, W) and its deformed area (B, 1, H, W) to the smallest window that holds it.

    Outside of the deformed area the gradient is zero, so the window changes nothing but the time. Elsewhere than on a CPU,
    in exported programs, and where little would be saved, the window is the whole image: finding it would wait for the device.

    Args:
        stride: the corners of the window are multiples of it.
        enabled: False for models that need the whole image.
    """

    enabled: Final[bool]

    def __init__(self, stride: int = 8, enabled: bool = True) -> None:
        super().__init__()
        self.stride = stride
        self.enabled = enabled

    def forward(self, compensated: Tensor, deformed: Tensor) -> Frame:
        height, width = compensated.shape[2], compensated.shape[3]
        top, bottom, left, right = 0, height, 0, width
        if self.finds_window(compensated) and deformed.shape[0] > 0:
            top, bottom, left, right = self.window(self.box(deformed), height, width)
        image, mask = compensated[:, :, top:bottom, left:right], deformed[:, :, top:bottom, left:right]
        return Frame(compensated, deformed, image, mask, (top, left), (height, width), None)

    def finds_window(self, images: Tensor) -> bool:
        """Whether the window depends on the images, and so on the batch."""
        return self.enabled and may_read(images)

    def box(self, deformed: Tensor) -> tuple[int, int, int, int]:
        """(top, bottom, left, right) of the smallest box that holds all deformed skin of all frames; zeros without any."""
        inside = as_factor(deformed, torch.zeros(1))
        rows, columns = inside.sum(dim=(0, 1, 3)).nonzero(), inside.sum(dim=(0, 1, 2)).nonzero()
        if rows.shape[0] == 0:
            return 0, 0, 0, 0
        return int(rows[0]), int(rows[-1]) + 1, int(columns[0]), int(columns[-1]) + 1

    def window(self, box: tuple[int, int, int, int], height: int, width: int) -> tuple[int, int, int, int]:
        """The box and the pixels beside it, from which depth has slopes, at least two strides wide, with corners on the stride."""
        stride = self.stride
        top, bottom, left, right = box
        top, left = max(0, top - 1) // stride * stride, max(0, left - 1) // stride * stride
        bottom = min(height, max((bottom + stride) // stride, top // stride + 2) * stride)
        right = min(width, max((right + stride) // stride, left // stride + 2) * stride)
        top, left = max(0, min(top, bottom - 2 * stride)), max(0, min(left, right - 2 * stride))
        if (bottom - top) * (right - left) > 0.8 * height * width or top % stride != 0 or left % stride != 0:
            return 0, height, 0, width
        return top, bottom, left, right


class Uncrop(nn.Module):
    """Embed the solution and the contact of a window in the whole image: (frame, solution, contact) to :class:`DepthOutput`."""

    def forward(self, frame: Frame, solution: Solution, contact: Tensor) -> DepthOutput:
        (top, left), (height, width) = frame.window, frame.size
        gradient = solution.gradient
        rows, columns = gradient.shape[2], gradient.shape[3]
        normal = normal_from_gradient(gradient)
        if rows < height or columns < width:
            outside = [left, width - left - columns, top, height - top - rows]
            gradient, contact = nn.functional.pad(gradient, outside), nn.functional.pad(contact, outside)
            inside, normal = normal, normal.new_zeros([gradient.shape[0], 3, height, width])
            normal[:, 2].fill_(1.0)
            normal[:, :, top : top + rows, left : left + columns] = inside
        return DepthOutput(solution.depth_mm, gradient, normal, contact, frame.deformed)


class LargestChange(nn.Module):
    """Largest difference of two batches of depths, per frame, (B,)."""

    def forward(self, one: Tensor, other: Tensor) -> Tensor:
        return (one - other).abs().amax(dim=(1, 2, 3))


def undeformed_output(frame: Frame) -> DepthOutput:
    """The output for frames without deformed skin: depth zero, normals towards the camera."""
    like = frame.compensated
    normal = torch.zeros_like(like)
    normal[:, 2] = 1.0
    contact = torch.zeros_like(frame.deformed)
    return DepthOutput(torch.zeros_like(like[:, 0:1]), torch.zeros_like(like[:, 0:2]), normal, contact, frame.deformed)


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
