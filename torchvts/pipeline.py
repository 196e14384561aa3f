"""Online: a calibration made into a chain of modules that turns images into depth."""

from typing import Final, NamedTuple

import torch
from torch import Tensor, nn

from .compensate import Compensate
from .contact import ContactMask
from .core.checks import check_batch, check_range, may_read_values
from .core.geometry import GradientFromNormal, normal_from_gradient
from .integration import PoissonRest
from .normals import NormalFromIntensity, NormalFromResponse
from .record import Calibration

MODES = ("fast", "precise", "auto")


class DepthOutput(NamedTuple):
    """depth_mm (B, 1, H, W); gradient (B, 2, H, W), mm per mm; normal (B, 3, H, W), unit; contact (B, 1, H, W) bool."""

    depth_mm: Tensor
    gradient: Tensor
    normal: Tensor
    contact: Tensor


class DepthPipeline(nn.Module):
    """Compensate, contact, normals, gradient, integrate: the chain, by composition.

    ``fast`` goes once (eq. 9). ``precise`` goes again with the depth found (eq. 10), until what is still missing, foreseen
    from how fast the change shrinks, is below ``tolerance_px``. ``auto`` skips frames without contact, and foresees on every
    eighth pixel what a second pass would change: only frames where that exceeds ``worth_px`` take the precise way. Frames
    of a batch do not influence one another.

    Args:
        compensate, contact, gradient, integrate: modules. normals: any module from a compensated image (B, 3, H, W) to
            normals (B, 3, H, W); one that sets ``uses_depth = True`` takes a second argument, the depth or None, and one
            that has ``coarse(stride)``, itself for every stride-th pixel, lets ``auto`` foresee; ``passes`` bounds the loop.
        mm_per_pixel: pixel pitch, mm. mode: "fast", "precise" or "auto".
        tolerance_px, worth_px: pixels of pitch. max_passes: bound of the precise loop.
    Source:
        figure 2 and eq. 3-10 of the paper; "auto" and the stopping rule are this project's.
    """

    refines: Final[bool]
    skips: Final[bool]
    foresees: Final[bool]

    def __init__(
        self,
        compensate: nn.Module,
        contact: nn.Module,
        normals: nn.Module,
        gradient: nn.Module,
        integrate: nn.Module,
        *,
        mm_per_pixel: float,
        mode: str = "fast",
        tolerance_px: float = 0.002,
        worth_px: float = 0.05,
        max_passes: int = 8,
    ) -> None:
        super().__init__()
        if mode not in MODES:
            raise ValueError(f"mode: expected one of {', '.join(MODES)}, got {mode!r}")
        uses_depth = bool(getattr(normals, "uses_depth", False))
        if mode == "precise" and not uses_depth:
            raise ValueError(
                f"mode: 'precise' hands the depth back to the normals, but {type(normals).__name__} does not take it: "
                "use 'fast', or set uses_depth = True and accept (compensated, depth_mm)"
            )
        self.compensate = compensate
        self.contact = contact
        self.normals = normals
        self.gradient = gradient
        self.integrate = integrate
        self.mode = mode
        self.mm_per_pixel = mm_per_pixel
        self.tolerance_px = tolerance_px
        self.worth_px = worth_px
        self.max_passes = min(max_passes, int(getattr(normals, "passes", max_passes)))
        self.refines = uses_depth and mode != "fast"
        self.skips = mode == "auto"
        coarse = getattr(normals, "coarse", None)
        self.foresees = self.skips and self.refines and callable(coarse)
        self.coarse_normals = coarse(8) if self.foresees and callable(coarse) else nn.Identity()
        self.coarse_integrate: nn.Module = PoissonRest(8 * mm_per_pixel) if self.foresees else nn.Identity()

    @classmethod
    def from_calibration(
        cls, calibration: Calibration, mode: str = "fast", *, normals: nn.Module | None = None, integrate: nn.Module | None = None
    ) -> "DepthPipeline":
        """The pipeline of a calibrated unit, in eval mode, its lights frozen (``requires_grad_(True)`` frees them).

        Args:
            calibration: from :func:`calibrate`, :meth:`Calibration.from_lights` or :meth:`Calibration.load`.
            mode: "fast", "precise" or "auto".
            normals, integrate: modules to put in place of the calibrated inverse model and PoissonRest. ``normals`` sees what
                the calibrated model would: the image scaled to the light model's, or image / background for a response field.
        Example:
            >>> from torchvts import PointLights, Sensor
            >>> lights = PointLights([[20, 0, 30], [-10, 17, 30], [-10, -17, 30]], [900, 900, 900])
            >>> cal = Calibration.from_lights(lights, Sensor("rig", 48, 64, 0.5))
            >>> out = DepthPipeline.from_calibration(cal)(cal.model_image[None])
            >>> out.depth_mm.shape, bool(out.contact.any())
            (torch.Size([1, 1, 48, 64]), False)
        """
        if not isinstance(calibration, Calibration):
            raise TypeError(f"calibration: expected a Calibration, got {type(calibration).__name__}: Calibration.load reads a file")
        sensor = calibration.sensor
        if normals is None:
            by_response = calibration.response is not None
            normals = (NormalFromResponse if by_response else NormalFromIntensity).from_calibration(calibration)
        modules = (
            Compensate.from_calibration(calibration),
            ContactMask.from_calibration(calibration),
            normals,
            GradientFromNormal(),
            integrate or PoissonRest(sensor.mm_per_pixel),
        )
        return cls(*modules, mm_per_pixel=sensor.mm_per_pixel, mode=mode).eval()

    def forward(self, images: Tensor) -> DepthOutput:
        """(B, 3, H, W) images in [0, 1], R, G, B.

        Raises:
            ValueError: wrong shape, or, for eager tensors on a CPU, values outside [0, 1] or not finite.
            TypeError: not floating point.
        """
        check_batch("images", images, 3)
        if not torch.jit.is_scripting():  # noqa: SIM102
            if images.device.type == "cpu" and not torch.compiler.is_compiling():
                check_range("images", images)
        compensated = self.compensate(images)
        contact = self.contact(compensated)
        if self.skips and may_read_values():  # noqa: SIM102
            if not bool(contact.any()):
                return _no_contact(compensated, contact)
        gradient = self.gradient(self.normals(compensated)) * contact
        depth = self.integrate(gradient)
        if self.refines:
            active = torch.ones(images.shape[0], dtype=torch.bool, device=images.device)
            if self.foresees:
                active = self._foreseen_px(compensated, contact, depth) > self.worth_px
            gradient, depth = self._refine(compensated, contact, gradient, depth, active)
        return DepthOutput(depth, gradient, normal_from_gradient(gradient), contact)

    def _refine(
        self, compensated: Tensor, contact: Tensor, gradient: Tensor, depth: Tensor, active: Tensor
    ) -> tuple[Tensor, Tensor]:
        if not torch.jit.is_scripting():  # noqa: SIM102
            if torch.compiler.is_exporting():
                return self._refine_in_graph(compensated, contact, gradient, depth, active)
        last_px = depth.detach().abs().amax(dim=(1, 2, 3)) / self.mm_per_pixel
        for _ in range(1, self.max_passes):
            if not bool(active.any()):
                break
            index = torch.where(active)[0]
            part = self.gradient(self.normals(compensated[index], depth[index])) * contact[index]
            found = self.integrate(part)
            change_px = (found - depth[index]).detach().abs().amax(dim=(1, 2, 3)) / self.mm_per_pixel
            gradient, depth = gradient.index_copy(0, index, part), depth.index_copy(0, index, found)
            # what is left is the change times r / (1 - r), r being the ratio of this change to the one before
            ratio = (change_px / last_px[index].clamp_min(1e-12)).clamp(0.0, 0.9)
            active = active.index_copy(0, index, change_px * ratio / (1.0 - ratio) > self.tolerance_px)
            last_px = last_px.index_copy(0, index, change_px)
        return gradient, depth

    def _refine_in_graph(
        self, compensated: Tensor, contact: Tensor, gradient: Tensor, depth: Tensor, active: Tensor
    ) -> tuple[Tensor, Tensor]:
        """:meth:`_refine` for torch.export: the loop as one operator, settled frames computed along and left as they are."""
        from torch._higher_order_ops.while_loop import while_loop

        def unsettled(step: Tensor, gradient: Tensor, depth: Tensor, active: Tensor, last_px: Tensor) -> Tensor:
            return active.any() & (step < self.max_passes)

        def go_again(step: Tensor, gradient: Tensor, depth: Tensor, active: Tensor, last_px: Tensor) -> tuple[Tensor, ...]:
            part = self.gradient(self.normals(compensated, depth)) * contact
            found = self.integrate(part)
            change_px = (found - depth).abs().amax(dim=(1, 2, 3)) / self.mm_per_pixel
            ratio = (change_px / last_px.clamp_min(1e-12)).clamp(0.0, 0.9)
            left = active & (change_px * ratio / (1.0 - ratio) > self.tolerance_px)
            frame = active[:, None, None, None]
            gradient, depth = torch.where(frame, part, gradient), torch.where(frame, found, depth)
            return step + 1, gradient.contiguous(), depth.contiguous(), left, torch.where(active, change_px, last_px)

        last_px = depth.abs().amax(dim=(1, 2, 3)) / self.mm_per_pixel
        step = torch.ones((), dtype=torch.int64, device=depth.device)
        state: tuple[Tensor, ...] = (step, gradient.contiguous(), depth.contiguous(), active, last_px)
        if self.max_passes == 2:  # one pass needs no loop, and stays differentiable
            state = go_again(*state)
        elif self.max_passes > 2:
            state = while_loop(unsettled, go_again, state)  # type: ignore[no-untyped-call]
        return state[1], state[2]

    def _foreseen_px(self, compensated: Tensor, contact: Tensor, depth: Tensor) -> Tensor:
        """Largest change of depth that a second pass would bring, per frame (B,), from every eighth pixel."""
        image = compensated.detach()[:, :, 4::8, 4::8]
        z = depth.detach()[:, :, 4::8, 4::8]
        inside = contact[:, :, 4::8, 4::8]
        change = self.gradient(self.coarse_normals(image, z)) - self.gradient(self.coarse_normals(image))
        change_mm: Tensor = self.coarse_integrate(change * inside)
        return change_mm.abs().amax(dim=(1, 2, 3)) / self.mm_per_pixel

    def extra_repr(self) -> str:
        return f"mode={self.mode}, mm_per_pixel={self.mm_per_pixel}"


def _no_contact(compensated: Tensor, contact: Tensor) -> DepthOutput:
    zero = torch.zeros_like(compensated)
    normal = zero.clone()
    normal[:, 2] = 1.0
    return DepthOutput(zero[:, 0:1], zero[:, 0:2], normal, contact)
