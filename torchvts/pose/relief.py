"""Reliefs: height, slope and contact of one depth frame on a pyramid of grids, in the right-handed frame."""

import math
from typing import NamedTuple, Protocol

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample, unfold

from ..core.blur import blur
from ..core.morphology import dilate

LEAST_DEPTH_MM = 0.03
"""Skin less deep than this counts as the transition zone around a contact, where it does not lie on the object."""

LEAST_SIDE = 16
"""Pixels along the shorter side of a frame."""

LEAST_PIXELS = 60
"""A contact of fewer pixels has no pose."""

LEAST_CELLS = 12
"""On its coarsest grid a contact has at least so many pixels."""

HUGE = 1e6
"""Depth, mm, and slopes beyond this are no measurement; their squares would overflow."""


class DepthFrame(Protocol):
    """The fields of :class:`torchvts.DepthOutput` that a registration uses."""

    @property
    def depth_mm(self) -> Tensor: ...
    @property
    def gradient(self) -> Tensor: ...
    @property
    def contact(self) -> Tensor: ...


class Relief(NamedTuple):
    """One frame on one grid, y up: z, slopes and second derivatives in ``field`` (6, H, W), order z, p, q, z_xx, z_xy, z_yy.

    Attributes:
        field: the six channels, mm, mm per mm, 1/mm.
        inside: (H, W) bool, where the skin lies on the object.
        near: (H, W) bool, possible contact, grown by a pixel: there is certainly no contact beyond it.
        x0: position of the upper left pixel, mm.
        y0: the same, y up.
        pitch: distance of pixels, mm.
        points: (N, 3), positions of the pixels inside, mm.
        slopes: (N, 2), slopes of the same pixels.
    """

    field: Tensor
    inside: Tensor
    near: Tensor
    x0: float
    y0: float
    pitch: float
    points: Tensor
    slopes: Tensor

    def sample(self, xy: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Sample at positions (..., 2): the channels (6, ...), and three masks (...): inside, near, in the image."""
        height, width = self.inside.shape
        column = (xy[..., 0] - self.x0) / self.pitch
        row = (self.y0 - xy[..., 1]) / self.pitch
        grid = torch.stack((column * (2.0 / max(width - 1, 1)) - 1.0, row * (2.0 / max(height - 1, 1)) - 1.0), -1)
        flat = grid.reshape(1, 1, -1, 2)
        channels = torch.cat((self.field, self.inside[None].to(self.field.dtype), self.near[None].to(self.field.dtype)))
        values = grid_sample(channels[None], flat, align_corners=True)[0, :, 0].reshape(8, *xy.shape[:-1])
        in_image = (column >= 0) & (column <= width - 1) & (row >= 0) & (row <= height - 1)
        return values[:6], (values[6] > 0.999) & in_image, values[7] > 0.001, in_image


class Levels(NamedTuple):
    """A frame on three grids, from fine to coarse, and the slope noise on the coarse one."""

    fine: Relief
    middle: Relief
    coarse: Relief
    noise: float


def check_frame(name: str, frame: DepthFrame) -> tuple[int, int]:
    """Height and width of one frame.

    Raises:
        TypeError: no DepthOutput, or one of integers.
        ValueError: not one frame, or parts of several sizes.
    """
    for part in ("depth_mm", "gradient", "contact"):
        value = getattr(frame, part, None)
        if not isinstance(value, Tensor):
            what = f"whose {part} is no tensor but {type(value).__name__}" if hasattr(frame, part) else f"which has no {part}"
            raise TypeError(f"{name}: expected a DepthOutput, as a DepthPipeline returns, got {type(frame).__name__}, {what}")
        if part != "contact" and not value.is_floating_point():
            raise TypeError(f"{name}: expected floating point {part}, got {value.dtype}: raw values of a file?")
    height, width = frame.depth_mm.shape[-2:] if frame.depth_mm.dim() >= 2 else (0, 0)
    for part, channels in (("depth_mm", 1), ("gradient", 2), ("contact", 1), ("deformed", 1)):
        shape = tuple(getattr(frame, part, frame.contact).shape)  # a scene has no deformed skin
        if math.prod(shape) != channels * height * width or shape[-2:] != (height, width):
            several = len(shape) >= 4 and shape[0] > 1
            cause = "loop over the batch" if several else f"depth_mm has {tuple(frame.depth_mm.shape)}"
            raise ValueError(f"{name}: expected one frame, {part} (1, {channels}, H, W), got {shape}: {cause}")
    return height, width


def contact_of(frame: DepthFrame, name: str) -> tuple[Tensor, Tensor, Tensor]:
    """Depth (H, W), gradient (2, H, W) (y down) and deformed area (H, W) bool of one frame, checked.

    All deformed skin counts: that beside the contact, as on the flanks of a stamp, moves with it and shows its rotation. A frame
    without a deformed area, as a scene is, has its contact in place of it.

    Raises:
        TypeError: no DepthOutput.
        ValueError: not one frame, shapes that differ, values not finite, or a contact of a few pixels.
    """
    height, width = check_frame(name, frame)
    depth, gradient = frame.depth_mm.detach(), frame.gradient.detach()
    deformed: Tensor = getattr(frame, "deformed", frame.contact).detach()
    if not bool((depth.abs() <= HUGE).all() and (gradient.abs() <= HUGE).all()):
        raise ValueError(f"{name}: expected finite depth and gradient, at most {HUGE:g}, got NaN, infinite or larger ones")
    inside = deformed.reshape(height, width).bool()
    if int(inside.sum()) < LEAST_PIXELS:
        raise ValueError(
            f"{name}: expected a contact of at least {LEAST_PIXELS} pixels, got {int(inside.sum())}: nothing is touched?"
        )
    return depth.reshape(height, width).float(), gradient.reshape(2, height, width).float(), inside


def levels(frame: DepthFrame, mm_per_pixel: float, name: str) -> Levels:
    """Resample a frame to grids of at most 320, 160 and 80 columns, each pixel the mean of those that it covers."""
    depth, gradient, contact = contact_of(frame, name)
    if min(depth.shape) < LEAST_SIDE:
        raise ValueError(
            f"{name}: expected a frame of at least {LEAST_SIDE} x {LEAST_SIDE}, got {depth.shape[0]} x {depth.shape[1]}"
        )
    noise = slope_noise(gradient, contact)
    inside = contact & (depth > least_depth_mm(noise, mm_per_pixel))
    # flat faces whose outline the image border cuts may be missing from the mask: they count as possible contact
    deep = depth > 0.3 * float(depth[contact].max())
    slope = torch.stack((gradient[0], -gradient[1]))  # y up
    longest = max(depth.shape)
    first = max(1, math.ceil(longest / 330))
    corner = (-0.5 * (depth.shape[1] - 1) * mm_per_pixel, 0.5 * (depth.shape[0] - 1) * mm_per_pixel)
    every = (first, max(first, round(longest / 160)), max(first, round(longest / 80)))
    if min(depth.shape) < 2 * every[2]:
        raise ValueError(
            f"{name}: expected a frame at most 40 times as long as wide, got {depth.shape[0]} x {depth.shape[1]}: a cut-out?"
        )
    made = [relief(depth, slope, inside, inside | deep, mm_per_pixel, times, corner) for times in every]
    cells = min(len(one.points) for one in made)
    if cells < LEAST_CELLS:
        least = least_depth_mm(noise, mm_per_pixel)
        raise ValueError(
            f"{name}: expected a contact deeper than {least:.3f} mm on {LEAST_CELLS} cells of {every[2]} x {every[2]} pixels, "
            f"got {cells} ({int(inside.sum())} pixels): pressed too faintly, too small, or depth is not in mm?"
        )
    return Levels(made[0], made[1], made[2], noise / every[2])


def without_rim(mask: Tensor) -> Tensor:
    """Remove the outermost pixels of a mask (1, H, W), unless hardly any others remain."""
    core = ~dilate(~mask[None])[0]
    return core if 5 * int(core.sum()) > 2 * int(mask.sum()) else mask


def least_depth_mm(noise: float, mm_per_pixel: float) -> float:
    """Least depth that is certainly contact: above the transition zone, and above the noise of slopes summed over some pixels."""
    return max(LEAST_DEPTH_MM, 4.0 * noise * mm_per_pixel)


def sure_contact(depth: Tensor, gradient: Tensor, contact: Tensor, mm_per_pixel: float) -> Tensor:
    """Contact deeper than :func:`least_depth_mm` without its rim of one pixel, (H, W) bool."""
    inside = contact & (depth > least_depth_mm(slope_noise(gradient, contact), mm_per_pixel))
    return without_rim(inside[None])[0]


def slope_noise(gradient: Tensor, contact: Tensor) -> float:
    """Noise of slopes inside the contact, from second differences along rows, as in :func:`torchvts.core.noise.noise_std`."""
    whole = contact[:, :-2] & contact[:, 1:-1] & contact[:, 2:]
    second = (gradient[..., 1:-1] - 0.5 * (gradient[..., :-2] + gradient[..., 2:]))[:, whole].abs()
    return float(second.median()) / (0.6745 * math.sqrt(1.5)) if second.numel() else 0.0


def relief(
    depth: Tensor, slope: Tensor, inside: Tensor, perhaps: Tensor, mm_per_pixel: float, times: int, corner: tuple[float, float]
) -> Relief:
    """One grid of a pyramid: means of ``times`` x ``times`` pixels.

    Args:
        depth: (H, W), mm.
        slope: (2, H, W), y up.
        inside: (H, W) bool, where the skin certainly lies on the object.
        perhaps: (H, W) bool, where it may lie on the object.
        mm_per_pixel: pitch of the input, mm.
        times: pixels per side that are averaged.
        corner: (x, y) of the first pixel, mm, y up.
    """
    height, width = depth.shape
    rows, columns = height // times * times, width // times * times
    stack = torch.cat((depth[None], slope))[:, :rows, :columns]
    share = torch.stack((inside, perhaps)).float()[:, :rows, :columns]
    if times > 1:
        within = avg_pool2d((stack * share[:1])[None], times)[0]
        stack, share = avg_pool2d(stack[None], times)[0], avg_pool2d(share[None], times)[0]
        stack = torch.where(share[:1] > 0.5, within / share[:1].clamp_min(0.5), stack)
    pitch = times * mm_per_pixel
    x0, y0 = corner[0] + 0.5 * (times - 1) * mm_per_pixel, corner[1] - 0.5 * (times - 1) * mm_per_pixel
    whole = share[:1] > (0.99 if times <= 2 else 0.5)
    if times <= 2:
        whole = without_rim(whole)  # half of the rim is transition zone
    near = dilate(share[None, 1:] > 0.01)[0]
    smooth = blur(stack[None, 1:], [0.25, 0.5, 0.25])[0]
    p_y, p_x = torch.gradient(smooth[0], spacing=pitch)
    q_y, q_x = torch.gradient(smooth[1], spacing=pitch)
    field = torch.cat((stack, p_x[None], 0.5 * (q_x - p_y)[None], -q_y[None]))
    mask = whole[0]
    row, column = (place.to(depth.dtype) for place in torch.nonzero(mask, as_tuple=True))
    points = torch.stack((x0 + column * pitch, y0 - row * pitch, stack[0][mask]), dim=1)
    return Relief(field, mask, near[0], x0, y0, pitch, points, stack[1:, mask].T.contiguous())


def slopes_of_planes(values: Tensor, inside: Tensor, pitch: float) -> Tensor:
    """Slopes (C, 2, H, W), along x and y (up), of planes of least squares through the 3 x 3 values (C, H, W) that lie inside."""
    side = (-1.0, 0.0, 1.0)
    place = values.new_tensor([[1.0, x, -y] for y in side for x in side])  # rows go down, y up
    weight = unfold(inside.to(place.dtype)[None, None], 3, padding=1)[0].T  # (H W, 9)
    around = unfold(values[:, None], 3, padding=1).permute(2, 1, 0) - values.flatten(1).T[:, None]  # (H W, 9, C)
    weighted = place.T * weight[:, None]  # (H W, 3, 9)
    ridge = torch.diag(place.new_tensor([1e-9, 1e-3, 1e-3]))
    plane = torch.linalg.solve(weighted @ place + ridge, weighted @ around)  # (H W, 3, C)
    slopes: Tensor = plane[:, 1:].permute(2, 1, 0).reshape(-1, 2, *inside.shape) / pitch
    return slopes
