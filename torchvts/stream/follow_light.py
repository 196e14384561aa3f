"""Follows slow drift of the light by the skin without contact, and divides it out of every frame."""

import numpy as np
import torch
from torch import Tensor

from ..core.arrays import Array, array_of, cell_means, cells_with_any, lower_median, widened
from ..core.checks import check_batch, check_field, check_least, check_range, check_same_size, check_shape
from ..core.geometry import pixel_grid_mm
from ..core.robust import tukey_weight
from ..model.calibration import PEDESTAL

TIME_CONSTANT_S = 1.0
"""The light is followed with this time constant: an LED that fades by 1 % a second is followed 1 % behind."""

LIGHT_STEP = 0.03
"""A larger difference to the light followed so far is a step: it is reported, and not learned."""

RECOVERY_S = 1.0
"""After a contact the gel takes this long to come back; an apparent change of light until then is not a step."""

NO_CONTACT = 0.25
"""A change of a channel's level that is not from a contact: contacts of thirteen real sensors make at most 0.05, on one whose
images are saturated 0.16."""

NOT_TO_BE_TRUSTED = "depth is not to be trusted; torchvts diagnose says what has changed"
"""What is said of frames in another light."""

LEAST_FREE = 0.25
"""Share of the skin that must be free of contact for the light to be measured on it."""


class FollowLight:
    """Follows slow drift of the light by the skin without contact, and divides it out of every frame.

    In each channel the light relative to the background is a plane over the image (a level and two tilts): LEDs fade, one side
    perhaps more. Three parameters cannot take the shape of an object, and they reach under a contact from the skin around it.

    * Cells (1/24 of the height) in contact or next to it, dark cells and saturated ones are never used, so that an object that lies
      on the skin is never learned.
    * The plane is fitted to the other cells robustly (Tukey) and moves by 1 - exp(-dt / :data:`TIME_CONSTANT_S`) of the difference.
    * With less than a quarter of the cells free, nothing is learned ("held").
    * A difference of more than 3 % to the light followed so far is not drift. Without contact, or where one plane explains 90 % of
      all cells to 1 %, or where a channel's level is off by a quarter, it is reported as a step ("stepped"). With a contact, which
      scatters light, and for a second after it, while the gel comes back, it is "held". Neither is learned; when the light comes
      back, following goes on.

    Args:
        background: (3, H, W), image value of the unit without contact.
    Attributes:
        state: "following", "held" or "stepped".
        steps: how often the light has stepped.
        plane: (3, 3) float64, level and tilts of each channel; 1, 0, 0 at the start.
    """

    def __init__(self, background: Tensor) -> None:
        check_field("background", background)
        check_range("background", background)
        if min(background.shape[1:]) < 4:
            raise ValueError(f"background: expected H and W of at least 4, got {tuple(background.shape)}: too small for cells")
        height, width = self.size = (background.shape[1], background.shape[2])
        self.cell = max(2, height // 24)
        self.plane = torch.tensor([[1.0, 0.0, 0.0]] * 3, dtype=torch.float64)
        self.set_background(background[None])
        rows, columns = self._background.shape[1:]
        y, x = np.meshgrid(np.linspace(-1.0, 1.0, rows), np.linspace(-1.0, 1.0, columns), indexing="ij")
        self._basis = np.stack((np.ones_like(x), x, y)).reshape(3, -1)  # (3, cells)
        reach_x, reach_y = width / (columns * self.cell), height / (rows * self.cell)  # some pixels lie beyond the last cells
        x_mm, y_mm = pixel_grid_mm(height, width, 1.0, background.dtype)
        self._x = (x_mm * 2.0 / width * reach_x)[None, :1].contiguous()
        self._y = (y_mm * 2.0 / height * reach_y)[None, :, :1].contiguous()
        self.state = "following"
        self.steps = 0
        self._since_contact_s = RECOVERY_S

    @property
    def level(self) -> list[float]:
        """The light in R, G, B relative to the background, at the image centre."""
        return [float(v) for v in self.plane[:, 0]]

    def correct(self, image: Tensor) -> Tensor:
        """The image (1, 3, H, W) as it would be in the background's light."""
        self._check(image)
        if float((self.plane - torch.tensor([1.0, 0.0, 0.0])).abs().max()) < 1e-5:
            return image
        given = image.detach().resolve_neg().cpu().numpy()
        level, tilt_x, tilt_y = (self.plane[None, :, k, None, None].numpy().astype(given.dtype) for k in range(3))
        plane = tilt_x * self._x.numpy() + (level + tilt_y * self._y.numpy())
        np.divide(given, plane, out=plane)
        return torch.from_numpy(np.clip(plane, 0.0, 1.0, out=plane))

    def update(self, image: Tensor, deformed: Tensor, seconds: float) -> str:
        """Learn from a frame.

        Args:
            image: (1, 3, H, W), as the camera gave it.
            deformed: (1, 1, H, W), where its skin has moved.
            seconds: time since the last frame.
        Returns:
            The state.
        """
        self._check(image)
        check_shape("deformed", deformed, (1, 1, *self.size), "image")
        check_least("seconds", seconds, -np.inf)
        cells, difference = self._difference(image)
        pressed = cells_with_any(deformed[0, 0].bool().cpu().numpy(), self.cell)
        usable = self._usable & (cells < 0.97)
        before = self.state
        self._since_contact_s = 0.0 if bool(pressed.any()) else self._since_contact_s + seconds
        free = usable & ~widened(pressed)
        enough = bool((free.sum((1, 2)) >= LEAST_FREE * usable.sum((1, 2))).all())
        change = self._fit(difference, free if enough else usable)
        if float(np.abs(change).sum(1).max()) > LIGHT_STEP:
            residual = np.abs(difference.reshape(3, -1) - change @ self._basis)[usable.reshape(3, -1)]
            smooth = residual.size > 0 and float((residual < 0.01).mean()) > 0.9
            large = float(np.abs(change[:, 0]).max()) > NO_CONTACT
            self.state = "stepped" if smooth or large or self._since_contact_s >= RECOVERY_S else "held"
        elif not enough:
            self.state = "held"
        else:
            self.state = "following"
            self._move((1.0 - float(np.exp(-max(0.0, seconds) / TIME_CONSTANT_S))) * change)
        self.steps += self.state == "stepped" and before != "stepped"
        return self.state

    def set_background(self, image: Tensor) -> None:
        """Take an image (1, 3, H, W) without contact, in the background's light, as what the cells look like."""
        self._check(image)
        background = cell_means(array_of(image[0]), self.cell).astype(np.float64)
        self._background = background + PEDESTAL
        self._usable = (background > 0.06) & (background < 0.97)

    def start(self, image: Tensor) -> None:
        """Take over the light of an image (1, 3, H, W) that is known to be without contact."""
        self._check(image)
        for _ in range(3):
            cells, difference = self._difference(image)
            self._move(self._fit(difference, self._usable & (cells < 0.97)))

    def _check(self, image: Tensor) -> None:
        check_batch("image", image, 3)
        if image.shape[0] != 1:
            raise ValueError(f"image: expected one frame, (1, 3, H, W), got {list(image.shape)}: frames come one by one")
        check_same_size("image", image, "the background", *self.size)

    def _move(self, change: Array) -> None:
        """Change the light by a relative plane (3, 3)."""
        self.plane += torch.from_numpy(change) * self.plane[:, :1]

    def _difference(self, image: Tensor) -> tuple[Array, Array]:
        """Cells of an image, and their relative difference to the light followed so far."""
        cells = cell_means(array_of(image[0]), self.cell).astype(np.float64)
        now = (self.plane.numpy() @ self._basis).reshape(cells.shape)
        return cells, (cells / now + PEDESTAL) / self._background - 1.0

    def _fit(self, values: Array, used: Array) -> Array:
        """A plane for each channel, (3, 3), by three rounds of Tukey's weights; tilts are regularised where few cells are used."""
        target, used = values.reshape(3, -1), used.reshape(3, -1)
        ridge = np.diag([1e-9, 0.02, 0.02]) * target.shape[1]
        plane = np.zeros((3, 3))
        plane[:, 0] = [lower_median(one[some]) if some.any() else 0.0 for one, some in zip(target, used, strict=True)]
        for _ in range(3):
            residual = np.abs(target - plane @ self._basis)
            scale = [lower_median(one[some]) if some.any() else 1.0 for one, some in zip(residual, used, strict=True)]
            ratio = residual / np.maximum(6.0 * np.array(scale), 2e-3)[:, None]
            weight = used * tukey_weight(torch.from_numpy(ratio)).numpy()
            weighted = weight[:, None] * self._basis
            right = (weighted @ target[:, :, None])[..., 0]
            plane = np.linalg.solve(weighted @ self._basis.T + ridge, right[..., None])[..., 0]
        return plane
