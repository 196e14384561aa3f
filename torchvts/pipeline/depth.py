"""The depth pipeline: a calibration made into a chain of modules that turns images into depth."""

from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Final, TypeVar

import torch
from torch import Tensor, nn

from ..compensate import Compensate, unchanged_light
from ..core.checks import (
    check_batch,
    check_choice,
    check_image,
    check_pitch,
    check_positive,
    check_range,
    check_record,
)
from ..core.frame import Conditions, DepthOutput, Frame, Solution
from ..core.geometry import GradientFromNormal, gradient_of_depth, normal_from_gradient
from ..core.settings import check_settings, settings_as_tensor
from ..integration import PoissonDCT
from ..model import Calibration, FillMarkers, Sensor, check_calibration
from ..normals import NormalFromIntensity, NormalFromMLP, NormalFromResponse, WrappedNormals, as_normal_model, check_domain
from ..skin import ContactFromDepth, ContactMask, ContactSettings, ZeroBackground, moved, unseen_deg
from .refine import Refine
from .solve import Solve

if TYPE_CHECKING:
    from .frozen import FrozenPipeline

_Module = TypeVar("_Module", bound=nn.Module)

MODES = ("fast", "precise")
"""Modes of a pipeline: one solve; solved again with the depth found."""


class DepthPipeline(nn.Module):
    """Images (B, 3, H, W) to a :class:`DepthOutput`: compensate, smooth, solve, mask, refine, contact, slopes.

    ``fast`` solves once (eq. 9). ``precise`` solves again with the depth found (eq. 10): three passes by lights, two by response
    fields, of which gradient and normals are those of the depth, in both modes. Both divide out how the light of a frame differs
    from the background's.
    Frames of a batch do not influence one another; their number may change the rounding of sums. This is a plain PyTorch module:
    it trains, exports and runs on a GPU. For a camera or a recording, :meth:`freeze` it.

    Args:
        compensate: camera image to compensated image.
        mask: how surely the skin has moved, (B, 1, H, W) in [0, 1]: a :class:`ContactMask`, or any module that makes it,
            bool or not, of the compensated image alone.
        normals: a :class:`~torchvts.normals.NormalModel`, or any module from a compensated image (B, 3, H, W) to normals (B, 3,
            H, W).
        gradient: normals to gradient.
        integrate: an :class:`~torchvts.integration.Integrator`, or any module from a gradient (B, 2, H, W) to depth (B, 1, H, W).
        mm_per_pixel: pixel pitch, mm.
        mode: "fast" or "precise".
        contact: depth and deformed area to contact, bool (B, 1, H, W); None for :class:`ContactFromDepth`.
    Source:
        figure 2 and eq. 3-10 of the paper.
    """

    takes_slopes: Final[bool]

    def __init__(
        self,
        compensate: nn.Module,
        mask: nn.Module,
        normals: nn.Module,
        gradient: nn.Module,
        integrate: nn.Module,
        *,
        mm_per_pixel: float,
        mode: str = "fast",
        contact: nn.Module | None = None,
    ) -> None:
        super().__init__()
        check_choice("mode", mode, MODES)
        touching = ContactFromDepth(mm_per_pixel) if contact is None else contact
        given = {"compensate": compensate, "mask": mask, "gradient": gradient, "integrate": integrate, "contact": touching}
        for name, block in given.items():
            check_record(name, block, nn.Module)
        mm_per_pixel = check_positive("mm_per_pixel", mm_per_pixel)
        model = as_normal_model(normals)
        check_pitch("normals", model, mm_per_pixel)
        check_pitch("integrate", integrate, mm_per_pixel)
        check_domain(model, compensate.output_domain if isinstance(compensate, Compensate) else None)
        if mode == "precise" and not (model.uses_depth or model.normals_from_depth):
            raise ValueError(
                f"mode: 'precise' hands the depth back to the normals, but {type(normals).__name__} does not take it: "
                "use 'fast', or make it a NormalModel with uses_depth = True"
            )
        self.mode = mode
        self.mm_per_pixel = mm_per_pixel
        self._sensor: Sensor | None = None  # of no calibration: nothing is known of the camera or the scale
        self._metric = False
        self.compensate = compensate
        self.mask = mask
        self.solve = Solve(model, gradient, integrate, ZeroBackground(mm_per_pixel))
        own = isinstance(mask, ContactMask) and type(mask).forward is ContactMask.forward
        self.takes_slopes = own and model.calibrated
        self.refine: nn.Module = Refine(self.solve, model.passes if mode == "precise" and model.uses_depth else 1)
        self.slopes_of_depth = model.normals_from_depth
        self.contact = touching

    def __setattr__(self, name: str, value: Any) -> None:
        if (name in ("mode", "mm_per_pixel") and name in self.__dict__) or name in ("normals", "gradient", "integrate"):
            raise AttributeError(
                f"{name}: expected to stay what the pipeline was made with, because its blocks hold it too: make another by "
                "DepthPipeline.from_calibration"
            )
        super().__setattr__(name, value)

    @classmethod
    def from_calibration(
        cls,
        calibration: Calibration,
        mode: str = "fast",
        *,
        normals: nn.Module | None = None,
        integrate: nn.Module | None = None,
        contact: ContactSettings | None = None,
    ) -> "DepthPipeline":
        """The pipeline of a calibrated unit, in eval mode, its lights frozen (``requires_grad_(True)`` frees them).

        Modules that are given keep the mode that they are in, train or eval, and their parameters stay trainable. No gradient
        reaches them from where the weight of moved skin is 0.

        Args:
            calibration: from :func:`calibrate`, :meth:`Calibration.from_lights` or :meth:`Calibration.load`.
            mode: "fast" or "precise".
            normals: module to put in place of the calibrated inverse model. It gets what that model would: the image scaled to the
                light model's, or image / background for a response field. One that declares another ``input_domain`` is refused.
                Mode precise refuses one that takes no depth.
            integrate: module to put in place of PoissonDCT.
            contact: thresholds of what has moved and what touches; None for those of the unit.
        Raises:
            TypeError: no Calibration, or no ContactSettings.
            ValueError: normals that work on other images.
        Example:
            >>> from torchvts import PointLights, Sensor
            >>> lights = PointLights([[20, 0, 30], [-10, 17, 30], [-10, -17, 30]], [900, 900, 900])
            >>> cal = Calibration.from_lights(lights, Sensor("rig", 48, 64, 0.5))
            >>> out = DepthPipeline.from_calibration(cal)(cal.model_image[None])
            >>> out.depth_mm.shape, bool(out.contact.any())
            (torch.Size([1, 1, 48, 64]), False)
        """
        check_calibration("calibration", calibration)
        settings = ContactSettings() if contact is None else contact
        check_record("contact", settings, ContactSettings, "ContactSettings(sigmas=...) makes one")
        sensor, given = calibration.sensor, (normals, integrate)
        with torch.inference_mode(False):  # later calls may record gradients
            if normals is None:
                by_response = calibration.response is not None
                normals = (NormalFromResponse if by_response else NormalFromIntensity).from_calibration(calibration)
            modules = (
                Compensate.from_calibration(calibration),
                ContactMask.from_calibration(calibration, settings),
                normals,
                GradientFromNormal(),
                PoissonDCT(sensor.mm_per_pixel, (sensor.height, sensor.width)) if integrate is None else integrate,
            )
            touching = ContactFromDepth.from_calibration(calibration, settings)
            pipe = cls(*modules, mm_per_pixel=sensor.mm_per_pixel, mode=mode, contact=touching)
            pipe._sensor, pipe._metric = sensor, calibration.metric
            return eval_around(pipe, *given)

    @classmethod
    def from_gs_sdk(
        cls,
        weights: str | Path,
        background: Tensor,
        sensor: Sensor | str,
        mode: str = "fast",
        markers: FillMarkers | None = None,
    ) -> "DepthPipeline":
        """The pipeline of a network that gs_sdk trained, on the images that it was trained on.

        Args:
            weights: gs_sdk's ``nnmodel.pth``, of which nothing but tensors is unpickled; or what ``torchvts train`` wrote.
            background: (3, H, W), image of the unit without contact in [0, 1], R, G, B; the network's gradients there are zero.
            sensor: the sensor, or what :meth:`Sensor.load` takes.
            mode: "fast", for a network takes no depth.
            markers: what filled the markers of the background, and fills those of frames; None for a skin without.
        Raises:
            FileNotFoundError: no such weights or sensor.
            ValueError, TypeError: no weights of such a network, another mode, or a background of another size, type or range.
        Example:
            >>> pipe = DepthPipeline.from_gs_sdk("nnmodel.pth", background, "gelsight_mini")  # doctest: +SKIP
        """
        sensor = sensor if isinstance(sensor, Sensor) else Sensor.load(sensor)
        check_image("background", background, sensor.height, sensor.width, sensor.name)
        network = NormalFromMLP.load(weights, background)
        compensate = Compensate(blur_px=network.blur_px, markers=markers)
        flat = compensate(background[None])[0].clamp(0.0, 1.0)
        network.set_flat(flat)
        modules = (compensate, ContactMask(flat), network, GradientFromNormal(), PoissonDCT(sensor.mm_per_pixel))
        return cls(*modules, mm_per_pixel=sensor.mm_per_pixel, mode=mode).eval()

    if TYPE_CHECKING:

        def __call__(self, images: Tensor) -> DepthOutput: ...

    def forward(self, images: Tensor) -> DepthOutput:
        """(B, 3, H, W) images in [0, 1], R, G, B.

        Raises:
            ValueError: wrong shape, or, for eager tensors, values outside [0, 1] or not finite.
            TypeError: not floating point, or a pipeline in half precision, in which light and depth have too few digits.
        """
        check_images(images)
        if not torch.jit.is_scripting():
            self._check_precision()
        frame, slopes = self.frame_of(images)  # eq. 9 and 5
        solution = self.solve.integrated(frame, slopes * frame.weight)  # eq. 4
        frame, solution = self.refine(frame, solution)  # eq. 10
        return self.output(frame, solution)

    @torch.jit.unused
    def _check_precision(self) -> None:
        kind = getattr(self.mask, "flat", torch.empty(0)).dtype
        if kind in (torch.float16, torch.bfloat16):
            raise TypeError(f"pipe: expected float32 or float64, got {kind}: halve a network alone, or use torch.autocast")

    def output(self, frame: Frame, solution: Solution) -> DepthOutput:
        """Depth and slopes of a solution, and where the skin has moved and the object touches it."""
        deformed = moved(frame.weight.detach(), solution.depth_mm.detach())
        contact = self.contact(solution.depth_mm.detach(), deformed)
        gradient = gradient_of_depth(solution.depth_mm, self.mm_per_pixel) if self.slopes_of_depth else solution.gradient
        return DepthOutput(solution.depth_mm, gradient, normal_from_gradient(gradient), contact, deformed)

    @torch.jit.unused
    def freeze(self) -> "FrozenPipeline":
        """This pipeline for frames of a camera or a recording, several times as fast: a copy that cannot change.

        Parameters and settings are those of now; no gradient is recorded. Where all blocks are the library's own, on a CPU in
        float32, a frame is one call of compiled code. What is not compiled, and why, says ``frozen.not_compiled``; that copy runs
        in PyTorch. As :func:`torch.jit.freeze` does for graphs.

        Raises:
            ValueError: parameters that record gradients.
        Example:
            >>> from torchvts import PointLights, Sensor
            >>> lights = PointLights([[20, 0, 30], [-10, 17, 30], [-10, -17, 30]], [900, 900, 900])
            >>> cal = Calibration.from_lights(lights, Sensor("rig", 48, 64, 0.5))
            >>> frozen = DepthPipeline.from_calibration(cal).freeze()
            >>> frozen(cal.model_image[None]).depth_mm.shape
            torch.Size([1, 1, 48, 64])
        """
        from .frozen import FrozenPipeline

        return FrozenPipeline(self)

    def frame_of(self, images: Tensor) -> tuple[Frame, Tensor]:
        """The frame of checked images (B, 3, H, W), compensated and weighted, and its slopes by eq. 9 and 5, (B, 2, H, W)."""
        image = self.compensate(images)
        slopes = self.solve.slopes(image, None)
        weight = self.mask(image, slopes) if self.takes_slopes else self.mask(image)
        return Frame(image, weight.to(image.dtype)), slopes

    @torch.jit.unused
    def conditions(self, images: Tensor) -> Conditions:
        """What images (B, 3, H, W) were seen under; raises as :meth:`forward`."""
        check_images(images)
        block: Any = self.compensate
        own = isinstance(block, Compensate)
        light, lost = (
            (block.light_of(images), block.lost(images)) if own else (unchanged_light(images), images.new_zeros(len(images), 3))
        )
        _, slopes = self.frame_of(images)
        return Conditions(light, lost, self.mask.unseen_deg(slopes) if isinstance(self.mask, ContactMask) else unseen_deg(slopes))

    __jit_unused_properties__: ClassVar[list[str]] = ["gradient", "integrate", "normals"]

    @property
    def normals(self) -> nn.Module:
        """The model of normals, as it was given."""
        model = self.solve.normals
        return model.module if isinstance(model, WrappedNormals) else model

    @property
    def gradient(self) -> nn.Module:
        """Normals to gradient."""
        return self.solve.gradient

    @property
    def integrate(self) -> nn.Module:
        """Gradient to depth."""
        return self.solve.integrate

    def get_extra_state(self) -> Tensor:
        """Numbers that determine the output and are no parameters, such as gamma and the pitch: part of ``state_dict()``."""
        return settings_as_tensor(self)

    def set_extra_state(self, state: Tensor) -> None:
        """Refuse the state of a pipeline with other settings, such as another unit's."""
        check_settings(self, state)

    def extra_repr(self) -> str:
        return f"mode={self.mode}, mm_per_pixel={self.mm_per_pixel}"


def eval_around(module: _Module, *given: nn.Module | None) -> _Module:
    """Put a module into eval mode, except the parts that were given to it, which keep the mode that they are in."""
    modes = [(part, part.training) for block in given if block is not None for part in block.modules()]
    module.eval()
    for part, training in modes:
        part.training = training
    return module


def check_images(images: Tensor) -> None:
    """Raise unless images are a floating-point (B, 3, H, W) batch, in eager mode also of values in [0, 1]."""
    check_batch("images", images, 3)
    if not torch.jit.is_scripting():  # noqa: SIM102
        if not torch.compiler.is_compiling() and (images.device.type == "cpu" or images.is_cuda):
            check_range("images", images)
