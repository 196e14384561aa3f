"""From a camera's image to the image the model speaks of: linear light, constant defects taken out, noise smoothed."""

import numpy as np
import torch
from torch import Tensor, nn

from ..core import native
from ..core.blur import blur, gaussian_weights
from ..core.checks import check_batch, check_field, check_positive, check_record, check_same_size, check_tensor, may_read_values
from ..core.native import may_use_native
from ..core.noise import median
from ..model.calibration import Calibration, check_calibration
from ..model.markers import FillMarkers


class Compensate(nn.Module):
    """Linear light, with what the model and the background disagree on taken out.

    Printed markers are filled first; ``compensated = image^gamma * gain + offset``; pixels named in ``defects`` then become
    the mean of their nearest sound neighbours, and the image is blurred. The multiplicative form (gain = model / background)
    is exact for albedo, spots and vignetting, the additive form of the paper (offset = I_delta = model - background) for
    ambient light.

    Args:
        gain: (3, H, W) or None for 1. offset: (3, H, W) or None for 0.
        gamma: camera response, value = light^(1/gamma).
        defects: (H, W) bool, pixels that tell nothing; None for none.
        blur_px: standard deviation of a Gaussian blur, pixels; 0 for none.
        markers: fills printed markers; None for a skin without.
        level: divide each channel of a frame by how bright its skin at rest is against calibration: by :func:`rest_level`, or
            given ``flat`` by :func:`sure_level`.
        flat: (3, H, W), what the compensated image is at rest. noise_std: (3, H, W), its noise.
        scatters: presses change the light of the whole skin a little, as on real sensors: then :func:`rest_level` up to its
            limit, and :func:`sure_level` beyond.
        beyond_full: (3, H, W), what channels that are full at rest are taken for while they are full, 0 for the others.
        full_light: linear light from which a channel is full.
    Source:
        eq. 8 of the paper for the offset.
    Example:
        >>> Compensate(offset=torch.full((3, 4, 4), 0.1))(torch.zeros(1, 3, 4, 4)).max()
        tensor(0.1000)
    """

    gain: Tensor | None
    offset: Tensor | None
    defect: Tensor
    sound: Tensor
    rest: Tensor | None
    rest_noise: Tensor | None
    beyond_full: Tensor | None

    def __init__(
        self,
        gain: Tensor | None = None,
        offset: Tensor | None = None,
        gamma: float = 1.0,
        defects: Tensor | None = None,
        blur_px: float = 0.0,
        markers: FillMarkers | None = None,
        level: bool = False,
        flat: Tensor | None = None,
        noise_std: Tensor | None = None,
        scatters: bool = False,
        beyond_full: Tensor | None = None,
        full_light: float = 1.0,
    ) -> None:
        super().__init__()
        self.level = level
        self.scatters = scatters
        if markers is not None:
            check_record("markers", markers, nn.Module, "FillMarkers() makes one")
        self.markers = nn.Identity() if markers is None else markers
        self.blur_px = float(blur_px) if blur_px == 0 else check_positive("blur_px", blur_px)
        self.gamma = check_positive("gamma", gamma)
        for name, value in (
            ("gain", gain),
            ("offset", offset),
            ("flat", flat),
            ("noise_std", noise_std),
            ("beyond_full", beyond_full),
        ):
            if value is not None:
                check_field(name, value)
        if defects is not None:
            check_tensor("defects", defects)
            if defects.dim() != 2 or defects.dtype != torch.bool:
                raise ValueError(f"defects: expected (H, W) bool, got {tuple(defects.shape)} {defects.dtype}: threshold it")
        if defects is None or not bool(defects.any()):
            sound = torch.zeros(0, 4, dtype=torch.int64)
            flat_index = torch.zeros(0, dtype=torch.int64)
        else:
            flat_index, sound = nearest_sound(defects)
        self.register_buffer("gain", None if gain is None else gain.detach().clone())
        self.register_buffer("offset", None if offset is None else offset.detach().clone())
        rest, noise = None, None
        if flat is not None and noise_std is not None:
            rest, noise = _some_means(flat[None])[0], _some_means(noise_std[None])[0]
            if self.blur_px == 0.0 and min(flat.shape[1], flat.shape[2]) >= 180:
                noise = noise / 3.0  # of a mean of nine
        self.register_buffer("rest", None if rest is None else rest.detach().clone())
        self.register_buffer("rest_noise", None if noise is None else noise.detach().clone())
        self.register_buffer("beyond_full", None if beyond_full is None else beyond_full.detach().clone())
        self.full_light = check_positive("full_light", full_light)
        self.register_buffer("defect", flat_index)
        self.register_buffer("sound", sound)
        self.weights = gaussian_weights(self.blur_px)

    @classmethod
    def from_calibration(cls, calibration: Calibration, level: bool = False) -> "Compensate":
        """What a calibrated unit's images need, so that at rest they become ``calibration.flat``.

        Args:
            calibration: of the unit.
            level: bring lamps that have drifted since back to their brightness. With response fields up to 15 % always are.
        """
        check_calibration("calibration", calibration)
        sensor = calibration.sensor
        parts = (calibration.gain, calibration.offset, sensor.exponent, calibration.defects, sensor.blur_px, calibration.markers)
        by_response = calibration.response is not None
        full = (calibration.saturated_model, calibration.saturation_light)
        if not level:
            return cls(*parts, by_response, None, None, False, *full)
        return cls(*parts, True, calibration.flat, calibration.compensated_noise_std, by_response, *full)

    def forward(self, image: Tensor) -> Tensor:
        """(B, 3, H, W) image in [0, 1] to (B, 3, H, W) linear light."""
        check_batch("image", image, 3)
        image = self.markers(image)
        light = image if self.gamma == 1.0 else image.clamp_min(1e-6) ** self.gamma
        gain, offset, beyond = self.gain, self.offset, self.beyond_full
        unseen = torch.zeros(0, dtype=torch.bool)
        if beyond is not None:
            check_same_size("image", image, "the calibration", beyond.shape[1], beyond.shape[2])
            unseen = (light >= self.full_light) & (beyond > 0)
        if gain is not None:
            check_same_size("image", image, "the calibration", gain.shape[1], gain.shape[2])
            light = light * gain
        if offset is not None:
            check_same_size("image", image, "the calibration", offset.shape[1], offset.shape[2])
            light = light + offset
        if beyond is not None:
            light = torch.where(unseen, beyond, light)
        if self.defect.shape[0] > 0:
            pixels = light.flatten(2)
            repaired = pixels[:, :, self.sound].mean(dim=3)  # (B, 3, N)
            light = pixels.index_copy(2, self.defect, repaired).reshape(light.shape)
        if self.blur_px > 0.0:
            light = blur(light, self.weights)
        if not self.level:
            return light
        rest, noise = self.rest, self.rest_noise
        if rest is None or noise is None:
            return light / rest_level(light)
        if self.scatters:
            near = rest_level(light)
            if may_read_values() and float((near - 1.0).abs().amax()) < 0.149:
                return light / near
            far = sure_level(_some_means(light.detach()), rest, noise)
            return light / torch.where((far - 1.0).abs() > 0.15, far, near)
        level = sure_level(_some_means(light.detach()), rest, noise)
        if may_read_values() and bool((level == 1.0).all()):
            return light
        return light / level if beyond is None else torch.where(unseen, beyond, light / level)


def rest_level(ratio: Tensor, least: float = 0.01, most: float = 0.15) -> Tensor:
    """How bright the skin at rest is in each channel of a frame, relative to the background: the mode of image / background.

    A press scatters light over the whole skin and lamps drift: on a GelSight Mini up to 1 %, on another 5 %. The mode is found by
    the narrowest half of the values, the narrowest half of that, and so on, and held to 1 +- ``most``. Where no channel is
    ``least`` off it is left at 1, because then the error of the mode is no smaller (relief 26 against 28 um on the first Mini);
    from twice that it counts in full. Scripts; no gradient flows through it.

    Args:
        ratio: (B, 3, H, W), image / background.
    Returns:
        (B, 3, 1, 1).
    Source:
        the half-sample mode: Bickel and Fruhwirth, Computational Statistics and Data Analysis 50(12), 2006.
    """
    drift = _mode(_sorted(_some(ratio.detach()).flatten(2))).clamp(-most, most)  # (B, 3)
    weight = (drift.abs().amax(dim=1, keepdim=True) / least - 1.0).clamp(0.0, 1.0)
    return (1.0 + weight * drift)[..., None, None]


def sure_level(light: Tensor, flat: Tensor, noise_std: Tensor, least: float = 0.01, most: float = 0.35) -> Tensor:
    """:func:`rest_level` for light models, which refuses where it cannot tell the skin at rest from contact.

    At the modes of the three channels, pixels at rest in all three at once are counted, each by exp(-chi^2 / 2), chi in units of
    noise; their means refine the modes. There must be 5 % of such pixels, and a channel's drift is believed only if they become
    less than 0.4 times as many without it, or 0.7 times if they are more than half of all: the flat top of a tilted punch larger
    than half of the image has a mode of its own in one channel, but the skin around it is at rest without. No gradient flows
    through it.

    Args:
        light: (B, 3, h, w), some pixels of compensated frames. flat: (3, h, w), the same at rest. noise_std: (3, h, w).
        least: drift that counts, and least noise, relative. most: largest drift that is believed.
    Returns:
        (B, 3, 1, 1), 1 where refused.
    Example:
        >>> flat = torch.full((3, 40, 40), 0.5)
        >>> frame = flat * torch.tensor([0.8, 1.0, 1.0]).reshape(3, 1, 1) + 0.001 * torch.randn(1, 3, 40, 40)
        >>> [round(float(v), 2) for v in sure_level(frame, flat, torch.full_like(flat, 0.002)).flatten()]
        [0.8, 1.0, 1.0]
    """
    flat = flat.clamp_min(1e-6)
    ratio = light.detach() / flat
    variance = (noise_std / flat) ** 2 + least**2
    if may_read_values() and bool(((median(ratio.flatten(2)) - 1.0).abs() < 0.5 * least).all()):
        return torch.ones_like(ratio[:, :, :1, :1])  # a lamp that drifts takes the middle of all pixels along
    pixels = _sorted(ratio.flatten(2))
    level = (1.0 + _mode(pixels))[..., None, None]
    for _ in range(2):
        chi = ((ratio - level) ** 2 / variance).sum(dim=1, keepdim=True)
        weight = torch.exp(-0.5 * chi) / variance
        level = (weight * ratio).sum(dim=(2, 3), keepdim=True) / weight.sum(dim=(2, 3), keepdim=True).clamp_min(1e-12)
    off = (ratio - level) ** 2 / variance
    chi = off.sum(dim=1, keepdim=True)
    # a Gaussian in three channels has a mean exp(-chi^2 / 2) of 2^(-3/2)
    at_rest = torch.exp(-0.5 * chi).mean(dim=(2, 3), keepdim=True) * 2.0**1.5
    without = torch.exp(-0.5 * (chi - off + (ratio - 1.0) ** 2 / variance)).mean(dim=(2, 3), keepdim=True) * 2.0**1.5
    drift = (level - 1.0).abs()
    share = torch.where(at_rest > 0.5, 0.7, 0.4)
    sure = (drift > least) & (drift < most) & (at_rest > 0.05) & (without < share * at_rest)
    return torch.where(sure, level, torch.ones_like(level))


def _some_means(image: Tensor) -> Tensor:
    """:func:`_some`, each the mean of 3 x 3 pixels where these do not overlap."""
    stride = max(1, min(image.shape[2], image.shape[3]) // 60)
    if stride < 3:
        return _some(image)
    first = stride // 2 - 1
    if may_use_native([image]):
        return _means_by_loops(image, stride, first)
    rows, columns = image.shape[2] // stride * stride, image.shape[3] // stride * stride
    total = image[:, :, first:rows:stride, first:columns:stride].clone()
    for k in range(1, 9):
        total += image[:, :, first + k // 3 : rows : stride, first + k % 3 : columns : stride]
    return total / 9.0


@torch.jit.unused
def _means_by_loops(image: Tensor, stride: int, first: int) -> Tensor:
    return native.some_means(image, stride, first)


def _some(image: Tensor) -> Tensor:
    """Some thousand pixels of a (B, C, H, W) image, on a grid."""
    stride = max(1, min(image.shape[2], image.shape[3]) // 60)
    return image[:, :, stride // 2 :: stride, stride // 2 :: stride]


def _mode(pixels: Tensor) -> Tensor:
    """Half-sample mode of each channel of (B, 3, N), sorted, less 1: (B, 3)."""
    for _ in range(4):
        half = (pixels.shape[2] + 1) // 2
        width = pixels[:, :, half - 1 :] - pixels[:, :, : pixels.shape[2] - half + 1]
        start = width.argmin(dim=2, keepdim=True)
        pixels = pixels.gather(2, start + torch.arange(half, device=pixels.device))
    return pixels[:, :, pixels.shape[2] // 2] - 1.0


def _sorted(values: Tensor) -> Tensor:
    """Sorted along the last dimension; by NumPy where Python runs: 0.03 ms for 3 x 4,800 values, torch 0.7."""
    if not torch.jit.is_scripting():  # noqa: SIM102
        if may_read_values() and values.device.type == "cpu":
            return torch.from_numpy(np.sort(values.numpy(), axis=-1))
    return values.sort(dim=-1).values


def nearest_sound(defects: Tensor) -> tuple[Tensor, Tensor]:
    """For every defect of an (H, W) bool mask its flat index (N,) and those of sound pixels to take its value from (N, 4).

    Left, right, above and below, the next sound pixel each; where the border comes first, the pixel found the other way.

    Raises:
        ValueError: a whole row and column through a defect is defective.
    """
    height, width = defects.shape
    rows, columns = torch.nonzero(defects, as_tuple=True)
    found, missing = [], []
    for dy, dx in ((0, -1), (0, 1), (-1, 0), (1, 0)):
        y, x = rows.clone(), columns.clone()
        for _ in range(max(height, width)):
            y_next, x_next = (y + dy).clamp(0, height - 1), (x + dx).clamp(0, width - 1)
            move = defects[y, x]
            if not bool((move & ((y_next != y) | (x_next != x))).any()):
                break
            y, x = torch.where(move, y_next, y), torch.where(move, x_next, x)
        found.append(y * width + x)
        missing.append(defects[y, x])
    index, lost = torch.stack(found, 1), torch.stack(missing, 1)
    if bool(lost.all(1).any()):
        raise ValueError("defects: expected sound pixels in the row or column of each defect, got none: the background is unusable")
    other_way, other_lost = index[:, [1, 0, 3, 2]], lost[:, [1, 0, 3, 2]]
    any_way = index.gather(1, (~lost).to(torch.int64).argmax(1, keepdim=True))
    return rows * width + columns, torch.where(lost, torch.where(other_lost, any_way, other_way), index)
