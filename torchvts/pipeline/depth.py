"""Online: a calibration made into a chain of modules that turns images into depth."""

from typing import Final, NamedTuple

import torch
from torch import Tensor, nn

from ..compensate.compensate import Compensate
from ..contact.masks import ContactMask
from ..core import native
from ..core.checks import (
    check_batch,
    check_choice,
    check_integer,
    check_least,
    check_positive,
    check_range,
    check_record,
    may_read_values,
    may_use_arrays,
)
from ..core.geometry import GradientFromNormal, normal_from_gradient
from ..core.native import may_use_native
from ..integration import PoissonBackground
from ..model.calibration import Calibration, check_calibration
from ..normals import NormalFromIntensity, NormalFromResponse
from ..normals.photometric import extrapolated_slope, slope_of_depth
from .confidence import Bounds, Confidence

MODES = ("fast", "precise", "auto")


class DepthOutput(NamedTuple):
    """depth_mm (B, 1, H, W); gradient (B, 2, H, W), mm per mm; normal (B, 3, H, W), unit; contact (B, 1, H, W) bool."""

    depth_mm: Tensor
    gradient: Tensor
    normal: Tensor
    contact: Tensor


class ConfidentOutput(NamedTuple):
    """The fields of :class:`DepthOutput`, then those of :class:`~torchvts.pipeline.Bounds`: how far they may be off.

    normal_95_deg, depth_95_mm (B, 1, H, W): within these the errors lie with a probability of 95 %; confidence (B, 1, H, W):
    probability that the normal is within 10 degrees; frame_confidence (B,): its mean over the contact; factors_deg (B, 5, H, W).
    """

    depth_mm: Tensor
    gradient: Tensor
    normal: Tensor
    contact: Tensor
    normal_95_deg: Tensor
    depth_95_mm: Tensor
    confidence: Tensor
    frame_confidence: Tensor
    factors_deg: Tensor


class DepthPipeline(nn.Module):
    """Compensate, contact, normals, gradient, integrate: the chain, by composition.

    ``fast`` goes once (eq. 9). ``precise`` goes again with the depth found (eq. 10), until what is still missing, foreseen
    from how fast the change shrinks, is below ``tolerance_px``. ``auto`` skips frames without contact, and foresees on every
    eighth pixel what a second pass would change: only frames where that exceeds ``worth_px`` go again, and stop when what is
    missing is below a fifth of it. Frames of a batch do not influence one another.

    Normals are sought only in the smallest window that holds all contact: outside, the gradient is zero. This changes nothing
    but the time. (Only on a CPU: elsewhere it would wait for the device.)

    Args:
        compensate, contact, gradient, integrate: modules. normals: any module from a compensated image (B, 3, H, W) to
            normals (B, 3, H, W); one that sets ``uses_depth = True`` takes a second argument, the depth or None, and one
            that has ``coarse(stride)``, itself for every stride-th pixel, lets ``auto`` foresee; ``passes`` bounds the loop.
            If normals and integrate set ``takes_window = True``, normals takes a third argument, the window's (top, left),
            and integrate takes that and the image's (height, width) after the gradient. One that also has all of ``blocked``,
            ``beyond`` and ``without_dark`` is asked again where a light is kept off: where ``blocked(compensated, window)`` is true
            it takes as a fourth argument slopes (B, 2, H, W) expected there, ``beyond(gradient, compensated, depth_mm, window)``
            tells which others would fit, ``without_dark(compensated, window)`` makes an image whose dark channels say nothing.
            If contact has ``shaded(compensated)`` too, skin at rest in a shadow is no contact.
        mm_per_pixel: pixel pitch, mm. mode: "fast", "precise" or "auto".
        tolerance_px, worth_px: pixels of pitch. max_passes: bound of the precise loop.
    Source:
        figure 2 and eq. 3-10 of the paper; "auto" and the stopping rule are this project's.
    """

    refines: Final[bool]
    skips: Final[bool]
    foresees: Final[bool]
    expects: Final[bool]
    shades: Final[bool]
    windows: Final[bool]
    stride: Final[int] = 8  # auto foresees on every so many pixels, and windows begin at such
    rounds: Final[int] = 3  # of doubt about dark channels

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
        check_choice("mode", mode, MODES)
        blocks = {"compensate": compensate, "contact": contact, "normals": normals, "gradient": gradient, "integrate": integrate}
        for name, block in blocks.items():
            check_record(name, block, nn.Module)
        check_positive("mm_per_pixel", mm_per_pixel), check_positive("tolerance_px", tolerance_px)
        check_least("worth_px", worth_px), check_integer("max_passes", max_passes, 1)
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
        self.tolerance_px = max(tolerance_px, 0.2 * worth_px) if mode == "auto" else tolerance_px
        self.worth_px = worth_px
        self.max_passes = min(max_passes, int(getattr(normals, "passes", max_passes)))
        self.refines = uses_depth and mode != "fast"
        self.skips = mode == "auto"
        self.windows = bool(getattr(normals, "takes_window", False)) and bool(getattr(integrate, "takes_window", False))
        self.expects = (
            self.refines
            and self.windows
            and all(callable(getattr(normals, name, None)) for name in ("blocked", "beyond", "without_dark"))
        )
        self.shades = self.expects and callable(getattr(contact, "shaded", None))
        # slopes are judged by a solver that cuts no edges: one that does makes a surface of anything
        self.judge: nn.Module = PoissonBackground(mm_per_pixel) if self.expects else nn.Identity()
        coarse = getattr(normals, "coarse", None)
        self.foresees = self.skips and self.refines and self.windows and callable(coarse)
        self.coarse_normals = coarse(self.stride) if self.foresees and callable(coarse) else nn.Identity()
        self.coarse_integrate: nn.Module = PoissonBackground(self.stride * mm_per_pixel) if self.foresees else nn.Identity()

    @classmethod
    def from_calibration(
        cls, calibration: Calibration, mode: str = "fast", *, normals: nn.Module | None = None, integrate: nn.Module | None = None
    ) -> "DepthPipeline":
        """The pipeline of a calibrated unit, in eval mode, its lights frozen (``requires_grad_(True)`` frees them).

        Args:
            calibration: from :func:`calibrate`, :meth:`Calibration.from_lights` or :meth:`Calibration.load`.
            mode: "fast", "precise" or "auto".
            normals, integrate: modules to put in place of the calibrated inverse model and PoissonBackground. ``normals`` sees what
                the calibrated model would: the image scaled to the light model's, or image / background for a response field.
        Raises:
            TypeError: no Calibration.
        Example:
            >>> from torchvts import PointLights, Sensor
            >>> lights = PointLights([[20, 0, 30], [-10, 17, 30], [-10, -17, 30]], [900, 900, 900])
            >>> cal = Calibration.from_lights(lights, Sensor("rig", 48, 64, 0.5))
            >>> out = DepthPipeline.from_calibration(cal)(cal.model_image[None])
            >>> out.depth_mm.shape, bool(out.contact.any())
            (torch.Size([1, 1, 48, 64]), False)
        """
        check_calibration("calibration", calibration)
        sensor = calibration.sensor
        if normals is None:
            by_response = calibration.response is not None
            normals = (NormalFromResponse if by_response else NormalFromIntensity).from_calibration(calibration)
        modules = (
            Compensate.from_calibration(calibration, level=mode == "auto"),
            ContactMask.from_calibration(calibration),
            normals,
            GradientFromNormal(),
            integrate or PoissonBackground(sensor.mm_per_pixel),
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
        if may_read_values() and (images.shape[0] == 0 or (self.skips and not bool(contact.any()))):
            return _no_contact(compensated, contact)
        height, width = images.shape[2], images.shape[3]
        top, bottom, left, right = 0, height, 0, width
        if self.windows and may_read_values() and images.device.type == "cpu":
            top, bottom, left, right = _window(contact, self.stride)
        seen = compensated[:, :, top:bottom, left:right]
        touched = contact[:, :, top:bottom, left:right]
        gradient, depth = self._solve(seen, None, touched, (top, left), (height, width))
        if self.refines:
            active = torch.ones(images.shape[0], dtype=torch.bool, device=images.device)
            if self.foresees and min(height, width) > self.stride + self.stride // 2:  # else its grid has one pixel a line
                active = self._foreseen_px(seen, touched, gradient, depth, (top, left)) > self.worth_px
            either, torn = False, active
            if self.expects:
                blocked: Tensor = self.normals.blocked(seen, (top, left)) & touched  # type: ignore[operator]
                torn = active & blocked.flatten(1).any(dim=1)
                either = not may_read_values() or bool(torn.any())
                if either:
                    shaded = torch.zeros_like(blocked)
                    if self.shades:
                        found: Tensor = self.contact.shaded(compensated)  # type: ignore[operator]
                        shaded = found[:, :, top:bottom, left:right] & blocked
                    seen, resting, blocked, gradient = self._doubt_dark(
                        seen, touched, shaded, blocked, gradient, torn, (top, left), (height, width)
                    )
                    touched = touched & ~resting
                    contact = nn.functional.pad(touched, [left, width - right, top, height - bottom])
                    depth = self.integrate(gradient, (top, left), (height, width))
                    gradient, depth = self._guess_again(seen, touched, gradient, depth, blocked, torn, (top, left))
            gradient, depth = self._refine(seen, touched, gradient, depth, active, (top, left))
            if self.expects and either:
                gradient, depth = self._look_beyond(seen, touched, gradient, depth, torn, (top, left))
        if may_use_native([gradient]):
            gradient, normal = _widen_by_loops(gradient, (top, left), (height, width))
            return DepthOutput(depth, gradient, normal, contact)
        normal = normal_from_gradient(gradient)
        if bottom - top < height or right - left < width:
            gradient = nn.functional.pad(gradient, [left, width - right, top, height - bottom])
            inside, normal = normal, normal.new_zeros([images.shape[0], 3, height, width])
            normal[:, 2].fill_(1.0)
            normal[:, :, top:bottom, left:right] = inside
        return DepthOutput(depth, gradient, normal, contact)

    def _solve(
        self, seen: Tensor, depth: Tensor | None, touched: Tensor, window: tuple[int, int], size: tuple[int, int]
    ) -> tuple[Tensor, Tensor]:
        """Gradient in the window, and depth of the whole image."""
        if self.windows:
            gradient = self.gradient(self.normals(seen, depth, window)) * _as_factor(touched, seen)
            return gradient, self.integrate(gradient, window, size)
        normal = self.normals(seen) if depth is None else self._normals_at(seen, depth)
        gradient = self.gradient(normal) * _as_factor(touched, seen)
        return gradient, self.integrate(gradient)

    def _normals_at(self, seen: Tensor, depth: Tensor) -> Tensor:
        normal: Tensor = self.normals(seen, depth) if self.refines else self.normals(seen)
        return normal

    def _doubt_dark(
        self,
        seen: Tensor,
        touched: Tensor,
        shaded: Tensor,
        blocked: Tensor,
        gradient: Tensor,
        torn: Tensor,
        window: tuple[int, int],
        size: tuple[int, int],
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Dark need not mean that the skin faces away: a shadow may fall on it, at rest or not, or dirt cover it. Where that leaves
        less contradiction, the skin is taken to be at rest, or else the dark channels to say nothing.

        Returns:
            the image, without the channels that say nothing; where the skin is at rest; where dark still means facing away; slopes.
        Source:
            Onn and Bruckstein, Integrability disambiguates surface recovery in two-image photometric stereo, IJCV 5(1), 1990.
        """
        resting, gradient = self._take(torch.zeros_like(gradient), shaded, touched, gradient, torn, window, size)
        blocked = blocked & ~resting
        apart: Tensor = self.normals.without_dark(seen, window)  # type: ignore[operator]
        other = self.gradient(self.normals(apart, None, window, torch.where(blocked, 0.0, gradient)))
        rim = nn.functional.max_pool2d(_as_factor(~touched, seen), 3, 1, 1) > 0.0  # walls of a pixel make no surface either
        cut, gradient = self._take(other, blocked & ~rim, touched, gradient, torn, window, size)
        return torch.where(cut, apart, seen), resting, blocked & ~cut, gradient

    def _take(
        self,
        other: Tensor,
        where: Tensor,
        touched: Tensor,
        gradient: Tensor,
        torn: Tensor,
        window: tuple[int, int],
        size: tuple[int, int],
    ) -> tuple[Tensor, Tensor]:
        """Other slopes somewhere, taken where a surface contradicts them less around a pixel, if that leaves less contradiction in
        the frame: where they were taken, and the slopes."""
        taken = torch.zeros_like(where)
        if may_read_values() and not bool(where.any()):
            return taken, gradient
        slopes, others = gradient.detach(), other.detach()
        misfit = self._misfit(slopes, self.judge(slopes, window, size), touched, window)
        for _ in range(self.rounds):
            mixed = torch.where(where, others, slopes)
            gained = self._misfit(mixed, self.judge(mixed, window, size), touched, window) - misfit
            here = where & (nn.functional.avg_pool2d(gained, 17, 1, 8) < 0.0)
            if may_read_values() and not bool(here.any()):
                break
            mixed = torch.where(here, others, slopes)
            after = self._misfit(mixed, self.judge(mixed, window, size), touched, window)
            better = (torn & ((after - misfit).sum(dim=(1, 2, 3)) < 0.0))[:, None, None, None]
            slopes, misfit = torch.where(better, mixed, slopes), torch.where(better, after, misfit)
            taken, where = taken | (here & better), where & ~here & better
        return taken, torch.where(taken, other, gradient)

    def _guess_again(
        self, seen: Tensor, touched: Tensor, gradient: Tensor, depth: Tensor, blocked: Tensor, torn: Tensor, window: tuple[int, int]
    ) -> tuple[Tensor, Tensor]:
        """Where a light is blocked, two slopes may fit: those near the plain inverse's, and those that the contact's lit pixels
        foretell. Each torn frame goes on with the ones that its depth contradicts less."""
        height, width = depth.shape[2], depth.shape[3]
        top, left = window
        expected = extrapolated_slope(gradient, touched & ~blocked, max(1, min(height, width) // 30), top, left)
        other = self.gradient(self.normals(seen, None, window, expected)) * _as_factor(touched, seen)
        found = self.integrate(other, window, (height, width))
        gained = self._misfit(other, found, touched, window) - self._misfit(gradient, depth, touched, window)
        better = (torn & (gained.sum(dim=(1, 2, 3)) < 0.0))[:, None, None, None]
        return torch.where(better, other, gradient), torch.where(better, found, depth)

    def _look_beyond(
        self, seen: Tensor, touched: Tensor, gradient: Tensor, depth: Tensor, torn: Tensor, window: tuple[int, int]
    ) -> tuple[Tensor, Tensor]:
        """The same for what was found in the end and its mirror image beyond the plane of the lit lights: taken where depth
        contradicts it less around a pixel, and kept if that leaves less contradiction in the frame."""
        height, width = depth.shape[2], depth.shape[3]
        top, left = window
        part = depth[:, :, top : top + seen.shape[2], left : left + seen.shape[3]]
        before = self._misfit(gradient, depth, touched, window)
        slope: Tensor = self.normals.beyond(gradient, seen, part, window)  # type: ignore[operator]
        slope = slope * _as_factor(touched, seen)
        found = self.integrate(slope, window, (height, width))
        slope, found = self._refine(seen, touched, slope, found, torn, window)
        gained = self._misfit(slope, found, touched, window) - before
        slope = torch.where(nn.functional.avg_pool2d(gained, 17, 1, 8) < 0.0, slope, gradient)
        found = self.integrate(slope, window, (height, width))
        slope, found = self._refine(seen, touched, slope, found, torn, window)
        gained = self._misfit(slope, found, touched, window) - before
        better = (torn & (gained.sum(dim=(1, 2, 3)) < 0.0))[:, None, None, None]
        return torch.where(better, slope, gradient), torch.where(better, found, depth)

    def _misfit(self, gradient: Tensor, depth: Tensor, touched: Tensor, window: tuple[int, int]) -> Tensor:
        """How much the slopes of the depth differ from those it was integrated from, squared, noise smoothed away: (B, 1, h, w)."""
        top, left = window
        part = depth[:, :, top : top + gradient.shape[2], left : left + gradient.shape[3]]
        apart = (slope_of_depth(part, self.mm_per_pixel) - gradient) * _as_factor(touched, gradient)
        return nn.functional.avg_pool2d(apart, 9, 1, 4).square().sum(dim=1, keepdim=True)

    def _refine(
        self, seen: Tensor, touched: Tensor, gradient: Tensor, depth: Tensor, active: Tensor, window: tuple[int, int]
    ) -> tuple[Tensor, Tensor]:
        if not torch.jit.is_scripting():  # noqa: SIM102
            if torch.compiler.is_exporting():
                return self._refine_in_graph(seen, touched, gradient, depth, active, (depth.shape[2], depth.shape[3]))
        last_px = depth.detach().abs().amax(dim=(1, 2, 3)) / self.mm_per_pixel
        size = (depth.shape[2], depth.shape[3])
        top, left = window
        bottom, right = top + seen.shape[2], left + seen.shape[3]
        for _ in range(1, self.max_passes):
            if not bool(active.any()):
                break
            index = torch.where(active)[0]
            every = index.shape[0] == active.shape[0]
            before = _at(depth, index, every)
            z = before[:, :, top:bottom, left:right]
            part, found = self._solve(_at(seen, index, every), z, _at(touched, index, every), window, size)
            change_px = _largest_change(found.detach(), before.detach()) / self.mm_per_pixel
            # what is left is the change times r / (1 - r), r being the ratio of this change to the one before
            ratio = (change_px / _at(last_px, index, every).clamp_min(1e-12)).clamp(0.0, 0.9)
            gradient, depth = _with(gradient, index, part, every), _with(depth, index, found, every)
            active = _with(active, index, change_px * ratio / (1.0 - ratio) > self.tolerance_px, every)
            last_px = _with(last_px, index, change_px, every)
        return gradient, depth

    def _refine_in_graph(
        self, seen: Tensor, touched: Tensor, gradient: Tensor, depth: Tensor, active: Tensor, size: tuple[int, int]
    ) -> tuple[Tensor, Tensor]:
        """:meth:`_refine` for torch.export: the loop as one operator, settled frames computed along and left as they are."""
        from torch._higher_order_ops.while_loop import while_loop

        def unsettled(step: Tensor, gradient: Tensor, depth: Tensor, active: Tensor, last_px: Tensor) -> Tensor:
            return active.any() & (step < self.max_passes)

        def go_again(step: Tensor, gradient: Tensor, depth: Tensor, active: Tensor, last_px: Tensor) -> tuple[Tensor, ...]:
            part, found = self._solve(seen, depth, touched, (0, 0), size)
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

    def _foreseen_px(self, seen: Tensor, touched: Tensor, gradient: Tensor, depth: Tensor, window: tuple[int, int]) -> Tensor:
        """Largest change of depth that a second pass would bring, per frame (B,), from every eighth pixel."""
        top, left = window
        first, step = self.stride // 2, self.stride
        image = seen.detach()[:, :, first::step, first::step]
        z = depth.detach()[:, :, top : top + seen.shape[2], left : left + seen.shape[3]][:, :, first::step, first::step]
        inside = _as_factor(touched[:, :, first::step, first::step], image)
        before = gradient.detach()[:, :, first::step, first::step]
        corner = (top // step, left // step)
        size = ((depth.shape[2] + step - first - 1) // step, (depth.shape[3] + step - first - 1) // step)
        change = self.gradient(self.coarse_normals(image, z, corner)) * inside - before
        found: Tensor = self.coarse_integrate(change, corner, size)
        return found.abs().amax(dim=(1, 2, 3)) / self.mm_per_pixel

    def extra_repr(self) -> str:
        return f"mode={self.mode}, mm_per_pixel={self.mm_per_pixel}"


class ConfidentPipeline(nn.Module):
    """A pipeline that tells how far its output may be off: images (B, 3, H, W) to a :class:`ConfidentOutput`.

    Args:
        pipe: the pipeline. confidence: from the same calibration.
    Example:
        >>> from torchvts import PointLights, Sensor
        >>> lights = PointLights([[20, 0, 30], [-10, 17, 30], [-10, -17, 30]], [900, 900, 900])
        >>> cal = Calibration.from_lights(lights, Sensor("rig", 48, 64, 0.5))
        >>> pipe = ConfidentPipeline(DepthPipeline.from_calibration(cal), Confidence.from_calibration(cal))
        >>> pipe(cal.model_image[None])._fields[4:]
        ('normal_95_deg', 'depth_95_mm', 'confidence', 'frame_confidence', 'factors_deg')
    """

    def __init__(self, pipe: DepthPipeline, confidence: Confidence) -> None:
        super().__init__()
        check_record("pipe", pipe, DepthPipeline, "DepthPipeline.from_calibration makes one")
        check_record("confidence", confidence, Confidence, "Confidence.from_calibration makes one")
        self.pipe = pipe
        self.confidence = confidence

    @classmethod
    def from_calibration(
        cls, calibration: Calibration, mode: str = "fast", *, normals: nn.Module | None = None, integrate: nn.Module | None = None
    ) -> "ConfidentPipeline":
        """As :meth:`DepthPipeline.from_calibration`.

        Raises:
            TypeError: no Calibration; or ``normals`` that are not the calibrated model.
        """
        pipe = DepthPipeline.from_calibration(calibration, mode, normals=normals, integrate=integrate)
        return cls(pipe, Confidence.from_calibration(calibration, pipe.normals)).eval()

    def forward(self, images: Tensor) -> ConfidentOutput:
        """As :meth:`DepthPipeline.forward`."""
        out: DepthOutput = self.pipe(images)
        told: Bounds = self.confidence(images, self.pipe.compensate(images), out.depth_mm, out.gradient, out.normal, out.contact)
        return ConfidentOutput(
            out.depth_mm,
            out.gradient,
            out.normal,
            out.contact,
            told.normal_95_deg,
            told.depth_95_mm,
            told.confidence,
            told.frame_confidence,
            told.factors_deg,
        )


def _largest_change(one: Tensor, other: Tensor) -> Tensor:
    """Of two batches of depths, per frame, (B,)."""
    if may_use_native([one, other]):
        return _largest_change_by_loops(one, other)
    return (one - other).abs().amax(dim=(1, 2, 3))


@torch.jit.unused
def _largest_change_by_loops(one: Tensor, other: Tensor) -> Tensor:
    return native.largest_change(one, other)


@torch.jit.unused
def _widen_by_loops(gradient: Tensor, window: tuple[int, int], size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    return native.widen(gradient, window, size)


def _no_contact(compensated: Tensor, contact: Tensor) -> DepthOutput:
    zero = torch.zeros_like(compensated)
    normal = zero.clone()
    normal[:, 2] = 1.0
    return DepthOutput(zero[:, 0:1], zero[:, 0:2], normal, contact)


def _at(frames: Tensor, index: Tensor, every: bool) -> Tensor:
    """Some frames of a batch, or as they are where that is every frame."""
    return frames if every else frames[index]


def _with(frames: Tensor, index: Tensor, some: Tensor, every: bool) -> Tensor:
    """A batch with some of its frames replaced."""
    return some if every else frames.index_copy(0, index, some)


def _as_factor(mask: Tensor, like: Tensor) -> Tensor:
    return mask.to(torch.uint8).to(like.dtype)  # four times as fast as straight from bool


def _box(contact: Tensor) -> tuple[int, int, int, int]:
    """(top, bottom, left, right) of the smallest box that holds all contact of all frames; zeros without contact."""
    if may_use_arrays(contact):
        return _box_by_array(contact)
    touched = _as_factor(contact, torch.zeros(1))
    rows, columns = touched.sum(dim=(0, 1, 3)).nonzero(), touched.sum(dim=(0, 1, 2)).nonzero()
    if rows.shape[0] == 0:
        return 0, 0, 0, 0
    return int(rows[0]), int(rows[-1]) + 1, int(columns[0]), int(columns[-1]) + 1


@torch.jit.unused
def _box_by_array(contact: Tensor) -> tuple[int, int, int, int]:
    """:func:`_box` by OpenCV; of 320 x 240 pixels in 0.01 ms where tensors take 0.05."""
    import cv2

    touched = contact[:, 0].to(torch.uint8).numpy()
    left, top, columns, rows = cv2.boundingRect(touched[0] if len(touched) == 1 else touched.max(axis=0))
    return top, top + rows, left, left + columns


def _window(contact: Tensor, stride: int) -> tuple[int, int, int, int]:
    """(top, bottom, left, right) of the part of the image that holds all contact and the pixels beside it, from which depth has
    slopes; its corners are multiples of ``stride``.

    All of the image where little would be saved, and at least two strides where there is no contact.
    """
    height, width = contact.shape[2], contact.shape[3]
    top, bottom, left, right = _box(contact)
    top, left = max(0, top - 1) // stride * stride, max(0, left - 1) // stride * stride
    bottom = min(height, max((bottom + stride) // stride, top // stride + 2) * stride)
    right = min(width, max((right + stride) // stride, left // stride + 2) * stride)
    top, left = max(0, min(top, bottom - 2 * stride)), max(0, min(left, right - 2 * stride))
    if (bottom - top) * (right - left) > 0.8 * height * width or top % stride != 0 or left % stride != 0:
        return 0, height, 0, width
    return top, bottom, left, right
