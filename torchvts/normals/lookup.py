"""Normals by a look-up table from the change of colour to the slope."""

import math
from pathlib import Path

import torch
from torch import Tensor, nn

from ..core.checks import check_batch, check_field, check_float_tensor, check_integer, check_least, check_same_size, check_tensor
from ..core.files import load_tensors, save_tensors
from ..core.geometry import normal_from_gradient
from .base import NormalModel

LOOKUP_KIND = "lookup_table"


class NormalFromLookup(NormalModel):
    """Unit normals by a table from the change of R, G, B against the flat skin to the slope, one table for all pixels.

    The slope is interpolated between the nodes of the table (trilinear), so that it is differentiable in the image; outside of the
    table the slope of its border holds. No change of colour gives exactly no slope. The table does not depend on the position in
    the image, so it suits lights that are far from the skin compared with its size, and a unit that was calibrated with a ball;
    :class:`NormalFromMLP` also uses the position. Make one with :meth:`fit`.

    Args:
        flat: (3, H, W), compensated image of the flat skin.
        table: (n, n, n, 2), slope (dz/dx, dz/dy) at change of R, G, B = (index - zero_index) * step.
        step: (3,), spacing of the nodes along R, G, B.
        zero_index: (3,) int64, the node of no change.
    Raises:
        ValueError: wrong shapes, not finite, a step that is not positive.
        TypeError: not floating point.
    Source:
        Johnson, Adelson, CVPR 2009; Yuan, Dong, Adelson, Sensors 17(12) 2762, 2017, section 4.
    Example:
        >>> change = torch.rand(500, 3) * 0.2 - 0.1
        >>> block = NormalFromLookup.fit(torch.full((3, 8, 8), 0.5), change, change[:, 0:2] - change[:, 2:3])
        >>> block(torch.full((1, 3, 8, 8), 0.5))[0, :, 0, 0] + 0.0
        tensor([0., 0., 1.])
    """

    calibrated: bool = True
    flat: Tensor
    table: Tensor
    step: Tensor
    zero_index: Tensor

    def __init__(self, flat: Tensor, table: Tensor, step: Tensor, zero_index: Tensor) -> None:
        super().__init__()
        check_field("flat", flat)
        for name, value in (("table", table), ("step", step), ("zero_index", zero_index)):
            check_tensor(name, value)
            if value.is_complex() or value.dtype == torch.bool:
                raise TypeError(f"{name}: expected numbers, got {value.dtype}")
        check_float_tensor("table", table)
        check_float_tensor("step", step)
        if table.dim() != 4 or tuple(table.shape) != (table.shape[0],) * 3 + (2,) or table.shape[0] < 3:
            raise ValueError(f"table: expected (n, n, n, 2) with n of 3 or more, got {tuple(table.shape)}")
        if tuple(step.shape) != (3,) or not bool((step > 0).all()) or not bool(torch.isfinite(step).all()):
            raise ValueError(f"step: expected three numbers above 0, got {step.tolist()}")
        if zero_index.dtype not in (torch.int32, torch.int64):
            raise TypeError(f"zero_index: expected whole numbers, int64, got {zero_index.dtype}")
        if tuple(zero_index.shape) != (3,) or not bool(((zero_index >= 0) & (zero_index < table.shape[0])).all()):
            raise ValueError(f"zero_index: expected three nodes of the table, 0 to {table.shape[0] - 1}, got {zero_index.tolist()}")
        if not bool(torch.isfinite(table).all()):
            raise ValueError("table: expected finite slopes, got NaN or infinite: fit() leaves none")
        zero = zero_index.to(torch.int64)
        # a node stands at no change, so that the slope there is zero to the last bit
        level = table.detach() - table.detach()[zero[0], zero[1], zero[2]]
        self.register_buffer("flat", flat.detach().clone())
        self.register_buffer("table", level.to(flat).contiguous())
        self.register_buffer("step", step.detach().to(flat).clone())
        self.register_buffer("zero_index", zero.to(flat.device).clone())

    def forward(self, compensated: Tensor, depth_mm: Tensor | None = None) -> Tensor:
        """(B, 3, H, W) compensated image to (B, 3, H, W) unit normals that face the camera."""
        check_batch("compensated", compensated, 3)
        check_same_size("compensated", compensated, "the calibration", self.flat.shape[1], self.flat.shape[2])
        bins = self.table.shape[0]
        zero = self.zero_index.to(compensated.dtype).reshape(1, 3, 1, 1)
        place = (compensated - self.flat) / self.step.reshape(1, 3, 1, 1) + zero
        place = place.clamp(0.0, bins - 1.0)
        # the index is clamped again, because NaN passes the line above
        low = place.detach().floor().to(torch.int64).clamp(0, bins - 2)
        upper = place - low
        lower = 1.0 - upper
        base = (low[:, 0] * bins + low[:, 1]) * bins + low[:, 2]  # (B, H, W)
        rows = self.table.reshape(bins * bins * bins, 2)
        blue = lower[:, 2, :, :, None], upper[:, 2, :, :, None]
        green = lower[:, 1, :, :, None], upper[:, 1, :, :, None]
        red = lower[:, 0, :, :, None], upper[:, 0, :, :, None]
        slope = torch.zeros_like(base, dtype=compensated.dtype)[..., None]
        for r in range(2):
            for g in range(2):
                start = base + (r * bins + g) * bins
                pair = torch.addcmul(rows[start] * blue[0], rows[start + 1], blue[1])  # (B, H, W, 2)
                slope = slope + pair * ((red[1] if r == 1 else red[0]) * (green[1] if g == 1 else green[0]))
        return normal_from_gradient(slope.permute(0, 3, 1, 2))

    @classmethod
    def fit(cls, flat: Tensor, change: Tensor, slope: Tensor, *, bins: int = 32, smoothing: float = 1.0) -> "NormalFromLookup":
        """Make the table from pixels of known slope, such as those inside presses of a ball.

        Every bin holds the mean slope of its pixels. Sums and counts are smoothed by a Gaussian in colour; where the smoothed count
        is below about one pixel, a Gaussian of twice the width decides, and so on, until every bin is filled from the nearest
        ones. Flat skin, no change at slope 0, is added as a tenth of the pixels, so that the slope of the table at no change,
        which is subtracted from the whole table, is small. (Without it, the error grows by 1.8 degrees on a GelSight Mini.)

        Args:
            flat: (3, H, W), compensated image of the flat skin.
            change: (N, 3), change of R, G, B against ``flat`` at these pixels.
            slope: (N, 2), true (dz/dx, dz/dy) there, mm per mm.
            bins: nodes of the table along each of R, G, B, at least 3.
            smoothing: standard deviation of the narrowest Gaussian, bins; 0 for none.
        Returns:
            The block, of the dtype of ``flat``.
        Raises:
            ValueError: wrong shapes, no pixels, not finite, all of one colour, bad bins or smoothing.
            TypeError: not floating point.
        Source:
            Yuan, Dong, Adelson, Sensors 17(12) 2762, 2017; the filling is normalised convolution, Knutsson and Westin,
            CVPR 1993.
        """
        check_field("flat", flat)
        check_integer("bins", bins, 3)
        if bins > 128:
            raise ValueError(f"bins: expected at most 128, got {bins}: the table holds bins^3 slopes")
        check_least("smoothing", smoothing, 0.0, bins)
        _check_samples("change", change, 3)
        _check_samples("slope", slope, 2)
        if change.shape[0] != slope.shape[0]:
            raise ValueError(f"slope: expected ({change.shape[0]}, 2) like change, got {tuple(slope.shape)}: one slope per pixel")
        colour, known = change.detach().double(), slope.detach().double()
        low, high = colour.amin(0).clamp_max(0.0), colour.amax(0).clamp_min(0.0)
        if float((high - low).min()) < 1e-6:
            raise ValueError(
                "change: expected colours that vary in R, G and B, got a channel that is 0 throughout: is it a contact?"
            )
        step = (high - low) / (bins - 2.0)  # one bin less, because zero is moved to a node
        zero = torch.ceil(-low / step).to(torch.int64)
        node = (torch.round(colour / step).to(torch.int64) + zero).clamp(0, bins - 1)
        index = (node[:, 0] * bins + node[:, 1]) * bins + node[:, 2]
        evidence = torch.cat((known, known.new_ones(known.shape[0], 1)), dim=1)  # sums of p and q, and the count
        volume = known.new_zeros(bins**3, 3).index_add_(0, index, evidence)
        volume[(zero[0] * bins + zero[1]) * bins + zero[2], 2] += max(1.0, 0.1 * known.shape[0])  # flat skin: slope 0
        table = _fill(volume.T.reshape(3, bins, bins, bins), known.mean(0), smoothing)
        return cls(flat, table.permute(1, 2, 3, 0), step, zero)

    def save(self, path: str | Path) -> None:
        """Write the table as one safetensors file, whole or not at all."""
        save_tensors(path, dict(self.state_dict()), {"kind": LOOKUP_KIND})

    @classmethod
    def load(cls, path: str | Path) -> "NormalFromLookup":
        """Read what :meth:`save` wrote. Nothing is unpickled.

        Raises:
            FileNotFoundError: no such file.
            ValueError: not a look-up table, damaged, or cut short.
        """
        tensors, described = load_tensors(path)
        names = ("flat", "table", "step", "zero_index")
        if described.get("kind") != LOOKUP_KIND or sorted(tensors) != sorted(names):
            raise ValueError(f"{path}: expected a look-up table with {', '.join(names)}, got {described.get('kind')!r}")
        try:
            return cls(tensors["flat"], tensors["table"], tensors["step"], tensors["zero_index"])
        except (TypeError, ValueError) as error:
            raise ValueError(f"{path}: damaged: {error}") from error

    def extra_repr(self) -> str:
        return f"bins={self.table.shape[0]}, height={self.flat.shape[1]}, width={self.flat.shape[2]}"


def _fill(sums: Tensor, mean: Tensor, smoothing: float) -> Tensor:
    """Slopes (2, n, n, n) from sums of p and q and counts (3, n, n, n), the widest Gaussian first; ``mean``: slope (2,) of all."""
    bins = sums.shape[1]
    widths = [float(smoothing)]
    while widths[-1] < bins:
        widths.append(max(1.0, 2.0 * widths[-1]))
    table = mean.reshape(2, 1, 1, 1).expand(2, bins, bins, bins)
    for width in reversed(widths):
        smooth = _gaussian(sums, width)
        table = (smooth[0:2] + table) / (smooth[2:3] + 1.0)  # the wider table weighs as one pixel
    return table


def _gaussian(volume: Tensor, width: float) -> Tensor:
    """Smooth each channel of (C, n, n, n) by a Gaussian of peak 1, which keeps counts of pixels comparable."""
    if width == 0.0:
        return volume
    reach = min(volume.shape[1] - 1, math.ceil(4.0 * width))
    offset = torch.arange(-reach, reach + 1, dtype=volume.dtype, device=volume.device)
    kernel = torch.exp(-0.5 * (offset / width) ** 2).reshape(1, 1, -1)
    for axis in (1, 2, 3):
        turned = volume.movedim(axis, 3)
        lines = turned.reshape(-1, 1, turned.shape[3])
        volume = nn.functional.conv1d(lines, kernel, padding=reach).reshape(turned.shape).movedim(3, axis)
    return volume


def _check_samples(name: str, values: Tensor, columns: int) -> None:
    if not isinstance(values, Tensor) or values.is_nested or values.dim() != 2 or values.shape[1] != columns or not len(values):
        got = tuple(values.shape) if isinstance(values, Tensor) and not values.is_nested else type(values).__name__
        raise ValueError(f"{name}: expected (N, {columns}), one row per pixel, got {got}")
    check_float_tensor(name, values)
    if not bool(torch.isfinite(values).all()):
        raise ValueError(f"{name}: expected finite values, got NaN or infinite: keep 3 pixels inside the rim of the ball's contact")
