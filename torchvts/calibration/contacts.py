"""What a fit uses of one press: the change of intensity, sampled pixels, and where the ball is."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from ..compensate import Compensate
from ..compensate.light import unchanged_light, unevenness
from ..core.blur import band_of_ratios, without_margin
from ..core.geometry import gradient_from_normal, pixel_grid_mm
from ..core.levels import BLACK, MOST_SATURATED, SATURATED
from ..core.morphology import dilate, erode
from ..integration import PoissonBackground
from ..model.calibration import PEDESTAL, Calibration
from ..model.report import PressRow
from ..model.response_field import MAX_SINE, ResponseField, ResponseModel
from ..model.sensor import Sensor
from ..normals import NormalFromResponse
from ..normals.shadowed import UNCHANGED_NOISES
from .presses import Press
from .regions import LIGHT_DRIFT, above_skin, contact_region

INSIDE = 0.85
"""Share of the contact radius within which the skin lies on the ball; further out it begins to leave it."""

RIM = 2.0
"""Standard deviations of the image's blur from the rim inwards in which the skin looks flatter than the ball."""

CORE = 0.5
"""Share of the contact radius, its core, that is used however small a contact is."""

LEAST_SAMPLES = 10
"""Sampled pixels that a contact needs inside of that radius, and the zone around it that a fit uses."""

ROUGH = 0.13
"""Structure between the channels of a background from which it is taken for a contact: :func:`channel_structure`."""

OTHER_SKIN = 0.1
"""Change of the least changed skin, relative, from which an image is that of another unit."""

MAX_SAMPLES = 2000
"""Pixels of a press that enter the fit. More add little, because neighbours are alike."""


@dataclass(eq=False)
class Contact:
    """One image's change of intensity, the pixels of it that a fit uses, and where the ball is.

    Attributes:
        name: for messages.
        change: (3, H, W) float64, image / background - 1.
        mask: (H, W) bool, the contact.
        index: (N,), flat indices of the sampled pixels.
        x: (N,), mm.
        y: (N,), mm.
        saturated: (N,) bool, pixels that are saturated in some channel, which is then a lower bound.
        radius_mm: of the ball.
        half_size_mm: (2,), half the width and height of the image, mm.
        center_mm: (2,), center of the ball, as far as known.
        contact_radius_mm: radius of the contact, as far as known.
        blur_mm: standard deviation of the blur of the image, mm.
        light: of the image, relative to the background's, (3, 6), see :meth:`torchvts.compensate.light.Relight.terms`.
        known: the center was given and is not searched.
        radius_known: the contact radius was given and is not searched.
        weight: how much of a press it counts, by what the others expect of it.
        doubt: why that is little, else empty.
        reason: why the contact is left out; empty if it is used.
        metrics: "error_deg" and "gain" of the report.
    """

    name: str
    change: Tensor
    mask: Tensor
    index: Tensor
    x: Tensor
    y: Tensor
    saturated: Tensor
    radius_mm: float
    half_size_mm: Tensor
    blur_mm: float
    center_mm: Tensor = field(default_factory=lambda: torch.zeros(2, dtype=torch.float64))
    contact_radius_mm: float = 0.0
    light: Tensor = field(default_factory=lambda: unchanged_light(torch.zeros(1, 3, 1, 1))[0])
    known: bool = False
    radius_known: bool = False
    weight: float = 1.0
    doubt: str = ""
    reason: str = ""
    metrics: dict[str, float] = field(default_factory=dict)

    def polar(self) -> tuple[Tensor, Tensor, Tensor]:
        """Sampled pixels relative to the center: x, y and distance, mm, (N,) each."""
        dx, dy = self.x - self.center_mm[0], self.y - self.center_mm[1]
        return dx, dy, torch.sqrt(dx * dx + dy * dy)

    def inside(self) -> Tensor:
        """(N,) bool: sampled pixels where the skin lies on the ball. Saturated ones too: frames have them, and a field that was not
        fitted to them is 1.5 to 2 times as far off there."""
        rim = RIM * self.blur_mm / max(self.contact_radius_mm, 1e-9)
        return self.polar()[2] < min(INSIDE, max(CORE, 1.0 - rim)) * self.contact_radius_mm

    def height_above_equator(self) -> Tensor:
        """(N,) mm: height of the ball's surface above its equator; where its sine is beyond ``MAX_SINE``, that at it."""
        return (self.radius_mm**2 - self.polar()[2].clamp_max(MAX_SINE * self.radius_mm).square()).sqrt()

    def ball_slope(self) -> Tensor:
        """(2, N): slope of the ball's surface at the sampled pixels."""
        dx, dy, _ = self.polar()
        return -torch.stack((dx, dy)) / self.height_above_equator()


class NoUsablePress(ValueError):
    """No press can be used for a fit; ``contacts`` carry the reasons."""

    def __init__(self, contacts: Sequence[Contact]) -> None:
        super().__init__("presses: none can be used: " + "; ".join(f"{c.name}: {c.reason}" for c in contacts))
        self.contacts = list(contacts)


def used(contacts: Sequence[Contact]) -> list[Contact]:
    """The contacts that are not left out."""
    return [contact for contact in contacts if not contact.reason]


def uneven_light(contacts: Sequence[Contact]) -> float:
    """Unevenness of what the light of all contacts has in common beside the background's, root mean square over the channels.

    That of one contact is there once; that of another gamma, saturation or lamp in all of them.
    """
    common = torch.stack([contact.light / contact.light[:, :1].clamp_min(1e-6) for contact in contacts]).mean(dim=0)
    return float(unevenness(common[None]).square().mean().sqrt())


def read_contacts(given: Sequence[Press], background: Tensor, sensor: Sensor) -> list[Contact]:
    """The contacts of presses, as the pipeline sees them. Those that show no contact carry a reason.

    Args:
        given: presses.
        background: (3, H, W) in [0, 1].
        sensor: of the unit, with the gamma and blur of the preprocessing.
    """
    before = ResponseModel.zero(sensor.exponent, sensor.blur_px)  # its response is not known yet
    unit = Calibration.from_response(before, sensor, background.double())
    # in single precision, as frames are: 8 bits are a thousand times as coarse, and the compiled kernels take a tenth of the time
    compensate = Compensate.from_calibration(unit).float()
    noise = unit.compensated_noise_std.clamp_min(LIGHT_DRIFT).float()
    contacts = []
    for item in given:
        ratio = compensate(item.image.detach().cpu().float()[None])
        change = ratio[0] - 1.0
        black = ((item.image <= BLACK) | (background <= BLACK)).cpu()  # a camera may cut off more of one image than of the other
        seen = change.masked_fill(black, 0.0)
        differs = differing(seen, noise)
        above, spread = above_skin(seen)
        region = contact_region(above, differs, 0.5 * item.ball_diameter_mm / sensor.mm_per_pixel)
        saturated = ((item.image > SATURATED) & (background < SATURATED)).any(dim=0).cpu()
        contact = _sampled(item, change.double(), region, saturated, sensor)
        contact.light = compensate.light_of(item.image.detach().cpu().float()[None])[0].double()
        contact.reason = _no_press(differs, spread) or _saturated(float(saturated[region].double().mean()))
        if item.center_px is not None:
            _place(contact, item, sensor)
        contacts.append(contact)
    return contacts


def differing(change: Tensor, noise_std: Tensor) -> Tensor:
    """Where an image differs from another by more than its noise, bool (H, W), without specks: what is smaller than 5 x 5 pixels.

    Args:
        change: (3, H, W).
        noise_std: its noise, (3, H, W), or what broadcasts to it.
    """
    strong = (change / noise_std).square().sum(0) > UNCHANGED_NOISES**2
    closed = erode(dilate(strong[None, None]))  # pixels lost to noise
    return dilate(erode(closed, 2), 2)[0, 0]


def _sampled(given: Press, change: Tensor, mask: Tensor, saturated: Tensor, sensor: Sensor) -> Contact:
    rows, columns = torch.nonzero(mask, as_tuple=True)
    stride = max(1, math.ceil(math.sqrt(len(rows) / MAX_SAMPLES)))
    kept = (rows % stride == 0) & (columns % stride == 0)
    rows, columns = rows[kept], columns[kept]
    x, y = pixel_grid_mm(sensor.height, sensor.width, sensor.mm_per_pixel, torch.float64)
    radius_mm = 0.5 * given.ball_diameter_mm
    index, half = rows * sensor.width + columns, middle_px(sensor) * sensor.mm_per_pixel
    blur_mm = sensor.blur_px * sensor.mm_per_pixel
    return Contact(given.name, change, mask, index, x[0, columns], y[rows, 0], saturated.flatten()[index], radius_mm, half, blur_mm)


def _place(contact: Contact, press: Press, sensor: Sensor) -> None:
    """Put the ball at the given center."""
    contact.known = True
    contact.center_mm = (torch.tensor(press.center_px, dtype=torch.float64) - middle_px(sensor)) * sensor.mm_per_pixel
    contact.radius_known = press.contact_radius_px is not None
    radius_px = press.contact_radius_px or math.sqrt(float(contact.mask.sum()) / math.pi) * 0.6
    contact.contact_radius_mm = min(radius_px * sensor.mm_per_pixel, 0.9 * contact.radius_mm)


def _no_press(differs: Tensor, spread: float) -> str:
    """Why an image shows no press, or "". ``differs``: (H, W), where it differs from the background."""
    share = float(differs.double().mean())
    border = torch.cat((differs[0], differs[-1], differs[:, 0], differs[:, -1])).double().mean()
    if share < 0.002:
        return (
            f"no contact: only {share:.2%} of the image differs from the background; is it the background itself, or a faint press?"
        )
    if float(border) > 0.6 and spread > OTHER_SKIN:
        return f"{share:.0%} of the image differs from the background: another unit, other exposure, or the light has changed"
    return ""


def _saturated(share: float) -> str:
    """That too much of the contact is saturated, or ""."""
    return f"{share:.0%} of the contact is saturated: lower the exposure" if share > MOST_SATURATED else ""


def middle_px(sensor: Sensor) -> Tensor:
    """(x, y) of the image centre, the origin of positions in mm, float64."""
    return torch.tensor([(sensor.width - 1) / 2, (sensor.height - 1) / 2], dtype=torch.float64)


def channel_structure(image: Tensor) -> float:
    """Structure between the channels of an image (3, H, W), within a few millimetres, relative to the light.

    The fall-off of an LED is smooth, and a spot is dark in all channels alike; a contact is bright in one channel where it is
    dark in another. The value is the 99th percentile of the channels' log ratios, band-passed (Gaussians of 1/40 and 1/16 of the
    height): 0.01 to 0.03 for the backgrounds of most sensors, 0.10 for a Wedge, whose LEDs are in the image; 0.06 to 0.36 under
    clear contact.
    """
    stride = max(1, min(image.shape[1:]) // 120)
    light = torch.nn.functional.avg_pool2d(image.detach().cpu().float()[None], stride)
    inner = without_margin(band_of_ratios(light, float(image.shape[1] // stride), PEDESTAL)[0])
    return float(inner.square().sum(0).sqrt().flatten().quantile(0.99))


def first_pass_depths(contacts: Sequence[Contact], response: ResponseField, pitch_mm: float) -> list[Tensor]:
    """(H, W) depth, mm, by a field for each contact, as the pipeline computes it in one pass."""
    if not contacts:
        return []
    height, width = contacts[0].mask.shape
    normals = NormalFromResponse(response, None, height, width, pitch_mm)
    integrate = PoissonBackground(pitch_mm)  # keeps its tables
    gradients = (gradient_from_normal(normals(1.0 + contact.change[None].float())) * contact.mask for contact in contacts)
    return [integrate(gradient)[0, 0].double() for gradient in gradients]


def press_row(contact: Contact, sensor: Sensor) -> PressRow:
    """The row of a press in the report."""
    row: PressRow = {"name": contact.name, "used": not contact.reason, "reason": contact.reason or contact.doubt}
    row["weight"] = 0.0 if contact.reason else contact.weight
    if "error_deg" in contact.metrics:
        row["error_deg"], row["gain"] = contact.metrics["error_deg"], contact.metrics["gain"]
    if "gain_std" in contact.metrics:
        row["gain_std"] = contact.metrics["gain_std"]
    if contact.contact_radius_mm > 0:
        row["center_px"] = (contact.center_mm / sensor.mm_per_pixel + middle_px(sensor)).tolist()
        row["contact_radius_px"] = contact.contact_radius_mm / sensor.mm_per_pixel
    return row
