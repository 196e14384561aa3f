"""A pipeline that cannot change: a frame in one call of compiled code, or, where that is not possible, in PyTorch."""

import copy
import platform
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.autograd import forward_ad

from ..compiled import NotCompiled, Plan, PlanError, check_block, library, plan_bytes, why_no_library
from ..compiled import blocks as compiled
from ..core import __version__
from ..core.checks import check_batch, check_image, check_path, check_range, check_record, check_same_size
from ..core.files import check_size, write_atomically
from ..core.frame import Conditions, DepthOutput
from .depth import DepthPipeline
from .refine import Refine
from .solve import Solve

SHAPES = (1, 2, 3, 1, 1)
"""Channels of the parts of a DepthOutput."""


class FrozenPipeline:
    """Images (B, 3, H, W) to a :class:`DepthOutput`, as the pipeline that it was made of; :meth:`DepthPipeline.freeze` makes one.

    It holds a copy, with every module in eval mode: nothing that is done to the pipeline afterwards changes it, and it records no
    gradient. Compiled, it takes float32 on a CPU. One thread works on a frame; the frames of a batch are shared among as many
    threads as torch uses, and equal bit for bit those frames alone. Depth differs from the pipeline's by rounding: less than
    1e-5 mm, and up to 2e-3 mm where a light has failed or an image is saturated, so that slopes are hardly determined.

    Args:
        pipe: the pipeline.
    Attributes:
        compiled: whether compiled code does the work.
        not_compiled: what has no compiled form, in words; empty where ``compiled``.
        mode: of the pipeline.
        mm_per_pixel: of the pipeline.
    Raises:
        ValueError: parameters that record gradients. TypeError: no pipeline.
    """

    __slots__ = ("_pipe", "_plan", "compiled", "mm_per_pixel", "mode", "not_compiled")

    compiled: bool
    not_compiled: str
    mode: str
    mm_per_pixel: float
    _pipe: DepthPipeline | None
    _plan: Plan | None

    def __init__(self, pipe: DepthPipeline) -> None:
        check_record("pipe", pipe, DepthPipeline, "DepthPipeline.from_calibration makes one")
        for name, weight in pipe.named_parameters():
            if weight.requires_grad:
                raise ValueError(
                    f"pipe: expected parameters that record no gradient, got {name}, which does: pipe.requires_grad_(False) ends "
                    "training; to train, call the pipeline itself"
                )
        with torch.inference_mode(False), torch.device("cpu"):  # whatever the defaults are
            own = copy.deepcopy(pipe).eval()
            plan, reason = None, ""
            try:
                plan = Plan(plan_bytes(values_of(own), about(own)))
            except (NotCompiled, PlanError) as error:
                reason = str(error)
        self._hold(own, plan, reason, own.mode, own.mm_per_pixel)

    def _hold(self, pipe: DepthPipeline | None, plan: Plan | None, reason: str, mode: str, mm_per_pixel: float) -> None:
        given: dict[str, object] = {
            "_pipe": pipe,
            "_plan": plan,
            "compiled": plan is not None,
            "not_compiled": reason,
            "mode": mode,
            "mm_per_pixel": mm_per_pixel,
        }
        for name, value in given.items():
            object.__setattr__(self, name, value)

    def save(self, path: str | Path) -> None:
        """Write the plan: one file that Python, C, robots and web pages read, see docs/plan.md; whole or not at all.

        Raises:
            ValueError: a pipeline that is not compiled.
            OSError: it cannot be written there.
        """
        plan = self._check_plan()
        with write_atomically(path) as temporary:
            temporary.write_bytes(plan.content())

    @classmethod
    def load(cls, path: str | Path) -> "FrozenPipeline":
        """Read a plan that :meth:`save` wrote.

        Raises:
            FileNotFoundError: no such file.
            ValueError: no plan, of another version, or damaged; names the file.
            RuntimeError: there is no compiled library, which a plan needs.
        Example:
            >>> from torchvts import Calibration, PointLights, Sensor
            >>> lights = PointLights([[20, 0, 30], [-10, 17, 30], [-10, -17, 30]], [900, 900, 900])
            >>> cal = Calibration.from_lights(lights, Sensor("rig", 48, 64, 0.5))
            >>> DepthPipeline.from_calibration(cal).freeze().save("unit.plan")  # doctest: +SKIP
            >>> FrozenPipeline.load("unit.plan")  # doctest: +SKIP
            FrozenPipeline(mode=fast, mm_per_pixel=0.5, compiled)
        """
        path = check_path("path", path)
        if not path.is_file():
            raise FileNotFoundError(f"{path}: no such file")
        check_size(path, "a plan")
        if library() is None:
            raise RuntimeError(f"{path}: a plan needs the compiled library, and there is none: {why_no_library()}")
        try:
            return cls._of(Plan(path.read_bytes()))
        except PlanError as error:
            raise ValueError(f"{path}: {error}") from error

    @classmethod
    def _of(cls, plan: Plan) -> "FrozenPipeline":
        found = cls.__new__(cls)
        found._hold(None, plan, "", str(plan.about.get("mode", "unknown")), plan.mm_per_pixel)
        return found

    def with_background(self, background: Tensor) -> "FrozenPipeline":
        """The same unit with another image without contact, as of a later day: by the plan alone, in C; this one stays as it is.

        What :func:`torchvts.stream.with_background` does with the calibration, for units by a response field. Printed markers are
        taken to be those of the plan.

        Args:
            background: (3, H, W) in [0, 1].
        Raises:
            ValueError: another shape, values outside [0, 1], no light; or a unit by point lights, or a pipeline that is not
                compiled.
        Example:
            >>> frozen = FrozenPipeline.load("unit.plan").with_background(background)  # doctest: +SKIP
        """
        plan = self._check_plan()
        check_image("background", background, *plan.size, str(plan.about.get("unit")))
        try:
            found = plan.with_background(background.detach().to("cpu", torch.float32).contiguous())
        except PlanError as error:
            raise ValueError(f"background: {error}") from error
        return self._of(found)

    def _check_plan(self) -> Plan:
        """The plan, or raise where there is none."""
        if self._plan is None:
            why = f"got one in PyTorch, because {self.not_compiled}"
            raise ValueError(f"pipe: expected one that is compiled, {why}: torchvts.export writes others")
        return self._plan

    def __setattr__(self, name: str, value: object) -> None:
        raise AttributeError(f"{name}: a frozen pipeline cannot change: change the pipeline, or make another, and freeze that")

    def __deepcopy__(self, memo: dict[int, Any]) -> "FrozenPipeline":
        return self

    def __reduce__(self) -> tuple[Any, ...]:
        if self._pipe is None:
            assert self._plan is not None
            return _of_bytes, (self._plan.content(),)
        return FrozenPipeline, (self._pipe,)

    def __repr__(self) -> str:
        how = "compiled" if self.compiled else f"in PyTorch: {self.not_compiled}"
        return f"FrozenPipeline(mode={self.mode}, mm_per_pixel={self.mm_per_pixel}, {how})"

    def __call__(self, images: Tensor) -> DepthOutput:
        """(B, 3, H, W) images in [0, 1], R, G, B; the output is new tensors.

        Raises:
            ValueError: wrong shape, values outside [0, 1] or not finite, or images that record gradients.
            TypeError: not floating point, or, compiled, no float32 on the CPU.
        """
        if self._plan is None:
            self._check(images)
            return self._in_pytorch(images)
        return self.with_conditions(images)[0]

    def with_conditions(self, images: Tensor) -> tuple[DepthOutput, Conditions]:
        """The output, and what the frames were seen under; at the price of the output.

        Raises:
            ValueError, TypeError: as calling it.
        """
        self._check(images)
        if self._plan is None:
            images = images.clone(memory_format=torch.contiguous_format)
            assert self._pipe is not None
            with torch.inference_mode():
                seen = self._pipe.conditions(images)
            return self._in_pytorch(images), Conditions(*(part.clone() for part in seen))
        with torch.inference_mode():
            images = images.resolve_neg().contiguous()
        count, size = images.shape[0], self._plan.size
        kinds = (torch.float32, torch.float32, torch.float32, torch.bool, torch.bool)
        parts = [torch.empty(count, c, *size, dtype=kind, device="cpu") for c, kind in zip(SHAPES, kinds, strict=True)]
        conditions = torch.empty(count, 22, dtype=torch.float32, device="cpu")
        threads = min(count, torch.get_num_threads())
        frames = range(count)
        if threads <= 1:
            for k in frames:
                self._frame(k, images, parts, conditions)
        else:
            with ThreadPoolExecutor(threads, thread_name_prefix="torchvts") as pool:  # where one fails, no other begins
                list(pool.map(lambda k: self._frame(k, images, parts, conditions), frames))
        unseen = torch.rad2deg(torch.atan(conditions[:, 21]))
        return DepthOutput(*parts), Conditions(conditions[:, :18].reshape(count, 3, 6), conditions[:, 18:21], unseen)

    def _frame(self, k: int, images: Tensor, parts: list[Tensor], conditions: Tensor) -> None:
        """Write the output of one frame of a batch, or raise if its values are not those of an image."""
        assert self._plan is not None
        if not self._plan.reconstruct(images[k], conditions[k], tuple(part[k] for part in parts)):
            check_range("images", images)

    def _in_pytorch(self, images: Tensor) -> DepthOutput:
        images = images.clone(memory_format=torch.contiguous_format)  # rounding depends on the layout
        assert self._pipe is not None
        with torch.inference_mode():
            output = self._pipe(images)
        # copies made outside of inference mode can be used wherever the user wants
        return DepthOutput(*(part.clone() for part in output))

    def _check(self, images: Tensor) -> None:
        check_batch("images", images, 3)
        if images.requires_grad and torch.is_grad_enabled():
            raise ValueError("images: expected none that record gradients: a frozen pipeline does not; call the pipeline itself")
        if forward_ad.unpack_dual(images).tangent is not None:  # type: ignore[no-untyped-call]
            raise ValueError("images: expected none with a tangent: a frozen pipeline has no derivative; call the pipeline itself")
        if self._plan is None:
            return
        if images.dtype != torch.float32 or not images.is_cpu:
            raise TypeError(f"images: expected torch.float32 on the CPU, got {images.dtype} on {images.device}: use .float().cpu()")
        check_same_size("images", images, "the calibration", *self._plan.size)
        try:
            images.data_ptr()
        except RuntimeError:
            check_range("images", images)  # says so of a frame of torch.func.vmap
            raise


def _of_bytes(content: bytes) -> FrozenPipeline:
    return FrozenPipeline._of(Plan(content))


def about(pipe: DepthPipeline) -> dict[str, object]:
    """What a plan says of itself: for people, and how its images lie in the frames of the camera."""
    made_by, sensor = f"torchvts {__version__} on {platform.system()} {platform.machine()}", pipe._sensor
    found = {"metric": pipe._metric, "length": "mm", "mode": pipe.mode, "made_by": made_by}
    if sensor is None:
        return found | {"unit": "", "view": None}
    view = sensor.view._asdict()
    return found | {"unit": view.pop("name"), "view": {name: value for name, value in view.items() if name != "size"}}


def values_of(pipe: DepthPipeline) -> dict[str, Any]:
    """The fields of a pipeline's plan.

    Raises:
        NotCompiled: what has no compiled form.
    """
    if library() is None:
        raise NotCompiled(f"there is no compiled library: {why_no_library()}")
    check_block("pipe", pipe, DepthPipeline)
    for name, tensor in (*pipe.named_parameters(), *pipe.named_buffers()):
        if not tensor.is_cpu or (tensor.is_floating_point() and tensor.dtype != torch.float32):
            raise NotCompiled(f"{name} is {tensor.dtype} on {tensor.device}")
    solve = pipe.solve
    check_block("solve", solve, Solve)
    values = compiled.normals_values("normals", solve.normals, solve.gradient)
    size = values["height"], values["width"]
    if values["mm_per_pixel"] is None:  # a response field by itself has none
        values["mm_per_pixel"] = pipe.mm_per_pixel
    compiled.check_equal("normals.mm_per_pixel", values["mm_per_pixel"], pipe.mm_per_pixel)
    values["metric"] = pipe._metric
    values |= compiled.compensate_values(pipe.compensate, size)
    compiled.check_solver("integrate", solve.integrate, pipe.mm_per_pixel)
    values |= compiled.mask_values(pipe.mask, size, pipe.takes_slopes)
    values |= compiled.zero_values(solve.zero, size) | compiled.contact_values(pipe.contact, size)
    values["slopes_of_depth"] = pipe.slopes_of_depth
    check_block("refine", pipe.refine, Refine)
    if pipe.refine.solve is not solve:
        raise NotCompiled("refine.solve is not that of the pipeline")
    values["passes"] = pipe.refine.passes
    return values
