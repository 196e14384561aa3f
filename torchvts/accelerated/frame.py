"""A whole frame in one compiled call, for pipelines of the library's own blocks: csrc/frame.c, its settings and its memory."""

import ctypes
import math
from collections.abc import Callable
from operator import attrgetter, is_
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import torch
from torch import Tensor, nn
from torch.nn.modules import module as torch_modules

from ..compensate import Blur, FillDefects
from ..compensate.drift import LEAST_DRIFT, MOST_BY_MODE, MOST_DRIFT, stride_of
from ..core.frame import DepthOutput
from ..core.robust import HALVINGS
from ..integration.background import DepthAsIs
from . import kernels
from .blocks import (
    Compensate,
    ContactFromDepth,
    ContactMask,
    Crop,
    Drift,
    GradientFromNormal,
    Masked,
    MaskedGradient,
    NormalFromIntensity,
    NormalFromResponse,
    PoissonBackground,
    SmoothDrift,
    Uncrop,
    ZeroBackground,
)
from .derived import flat_is_one, pedestals, response_lines
from .gate import usable
from .memory import empties
from .threads import by_frames, parts_of, within_frame

INTEGER, REAL, POINTER = ctypes.c_int32, ctypes.c_float, ctypes.c_void_p


class Program(ctypes.Structure):
    """``Program`` of csrc/frame.c."""

    _fields_ = (
        *((name, INTEGER) for name in ("height", "width", "taps")),
        *((name, POINTER) for name in ("gain", "offset", "weights", "defect", "neighbours")),
        ("defects", ctypes.c_int64),
        ("pedestal", REAL * 3),
        *((name, INTEGER) for name in ("drifts", "drift_stride", "halvings")),
        *((name, REAL) for name in ("least_drift", "most_drift", "believed_drift")),
        *((name, INTEGER) for name in ("step", "stride", "cell", "reach", "bridge")),
        *(
            (name, REAL)
            for name in ("sigmas", "rounding", "least_cells", "bridge_sigmas", "tail_sigmas", "least_spread", "least_colour")
        ),
        ("smooth", POINTER),
        *((name, POINTER) for name in ("flat", "per_noise", "failed_below", "most_far_field")),
        *((name, INTEGER) for name in ("corners", "degree", "terms")),
        *((name, POINTER) for name in ("place", "weight", "per_mm", "noise", "lit", "saturated", "inverse")),
        *((name, REAL) for name in ("max_sine", "steeper", "reference_mm", "per_slope", "pitch", "half_per_mm")),
        ("tables", POINTER),
        *((name, INTEGER) for name in ("passes", "zeroes", "sweeps", "slopes_of_depth")),
        *((name, REAL) for name in ("stiff", "tolerance")),
        *((name, INTEGER) for name in ("contact_cell", "contact_reach")),
        ("contact_model", REAL * 13),
    )


class Blocks(NamedTuple):
    """What a frame passes through.

    Attributes:
        slopes: the gradient of depth; None where that of pixels stays.
        passes: how often a frame is solved.
    """

    compensate: nn.Module
    smooth: nn.Module
    deformed: nn.Module
    crop: nn.Module
    normals: nn.Module
    gradient: nn.Module
    masked: nn.Module
    integrate: nn.Module
    zero: nn.Module
    slopes: nn.Module | None
    contact: nn.Module
    uncrop: nn.Module
    passes: int


OWN: tuple[tuple[type, ...], ...] = (
    (Compensate,),
    (SmoothDrift, nn.Identity),
    (ContactMask,),
    (Crop,),
    (NormalFromResponse, NormalFromIntensity),
    (GradientFromNormal,),
    (Masked,),
    (PoissonBackground,),
    (ZeroBackground, DepthAsIs),
    (MaskedGradient, type(None)),
    (ContactFromDepth,),
    (Uncrop,),
)
"""What each of the blocks may be."""


class _Prepared(NamedTuple):
    """A program, what holds the memory that it points to, and all that it was made of.

    Attributes:
        program: None where the blocks must do the work.
        shape: of a single frame for it.
        library: the compiled kernels.
        lights: the block whose lights may change by themselves, as by an optimiser.
        first, first_addresses: the tensors that the first stage of a frame reads.
        tensors, addresses, versions: of the blocks.
        modules, kinds: the blocks and those within them, and their types.
        sizes, lengths: dictionaries of attributes and of hooks, and how many entries they have.
        places, names, values: dictionaries and their entries: settings, and the modules and tensors within others.
    """

    program: Program | None
    shape: tuple[int, ...]
    library: Any
    lights: NormalFromIntensity | None
    memory: list[Any]
    first: list[Tensor]
    first_addresses: list[int]
    tensors: list[Tensor]
    addresses: list[int]
    versions: list[int]
    modules: list[nn.Module]
    kinds: list[type]
    sizes: list[dict[str, Any]]
    lengths: list[int]
    places: list[dict[str, Any]]
    names: list[str]
    values: list[Any]

    def holds(self) -> bool:
        """Whether nothing has changed since. Without loops of Python's own, because it runs before every frame."""
        if self.lights is not None:
            self.lights.follow_lights()
        return (
            list(map(len, self.sizes)) == self.lengths
            and list(map(type, self.modules)) == self.kinds
            and all(map(is_, map(dict.get, self.places, self.names), self.values))
            and list(map(_version, self.tensors)) == self.versions
            and list(map(Tensor.data_ptr, self.tensors)) == self.addresses
        )

    def begin(self, program: Program, images: Tensor) -> Tensor:
        """Has helpers begin with an image, if it is like those of the program and what the first stage reads is where it was.

        Returns:
            The image, rows contiguous if they have begun.
        """
        if type(images) is not Tensor or images.shape != self.shape or images.dtype is not torch.float32:
            return images
        if not images.is_cpu or images.layout is not torch.strided or torch._C._functorch.is_functorch_wrapped_tensor(images):
            return images
        if torch._C._len_torch_dispatch_stack() > 0 or images.data_ptr() == 0:  # traced, or zeros without memory
            return images
        if list(map(Tensor.data_ptr, self.first)) != self.first_addresses:
            return images
        images = images.contiguous()
        self.library.begin_frame(ctypes.byref(program), images.data_ptr(), within_frame())
        return images

    def records(self) -> bool:
        """Whether a gradient would be recorded for any of the tensors."""
        return torch.is_grad_enabled() and any(tensor.requires_grad for tensor in self.tensors)


_version = attrgetter("_version")

_programs: WeakKeyDictionary[nn.Module, _Prepared] = WeakKeyDictionary()

HOOKS = ("_forward_hooks", "_forward_pre_hooks")
"""Those of the way back matter only where gradients are recorded, which blocks do."""

OF_FIRST_STAGE = ("gain", "offset", "defect", "neighbours")
"""The buffers that Compensate reads."""

OF_MODULES = frozenset(nn.Module().__dict__)
"""What every module has; the rest of its dictionary are settings."""


def solve_frames(pipe: nn.Module, images: Tensor, parts: Callable[[], Blocks | None]) -> DepthOutput | None:
    """The output of a pipeline, each frame by itself, by one compiled call; None where its blocks must do it.

    Helpers begin with a single frame before it is known that the program holds: where other work came before a frame, to find that
    out and to wake them takes a tenth of its time.

    Args:
        pipe: the pipeline, beside which its program is kept.
        images: what it got.
        parts: gives its blocks, None where they are not known before a frame comes.
    """
    prepared = _programs.get(pipe)  # held until the call is over: another thread may put another one in its place
    if prepared is None or prepared.program is None:
        return _checked(pipe, prepared, images, parts)
    try:
        return _checked(pipe, prepared, prepared.begin(prepared.program, images), parts)
    finally:
        prepared.library.forget_frame()


def _checked(pipe: nn.Module, prepared: _Prepared | None, images: Tensor, parts: Callable[[], Blocks | None]) -> DepthOutput | None:
    """The output, after it was made sure that a program can do it and is that of the pipeline as it is now."""
    if not isinstance(images, Tensor) or images.dim() != 4 or images.shape[0] == 0 or images.shape[1] != 3 or not usable(images):
        return None
    if torch_modules._global_forward_hooks or torch_modules._global_forward_pre_hooks:
        return None
    if prepared is None or not prepared.holds():
        prepared = _prepared(pipe, parts())
        if prepared is None:
            return None
        _programs[pipe] = prepared
    program = prepared.program
    if program is None or prepared.records() or images.shape[2:] != (program.height, program.width):
        return None
    threads = within_frame() if parts_of(images.shape[0], images.shape[2] * images.shape[3]) == 1 else 1
    return _run(prepared.library.solve_frames, program, images.contiguous(), threads)


def program_of(pipe: nn.Module, parts: Callable[[], Blocks | None]) -> tuple[Program, list[Any]] | None:
    """The program of a pipeline, and what holds the memory that it points to; None where its blocks do the work."""
    prepared = _prepared(pipe, parts())
    return None if prepared is None or prepared.program is None else (prepared.program, prepared.memory)


def _prepared(pipe: nn.Module, parts: Blocks | None) -> _Prepared | None:
    """The program of a pipeline as it is now; None where torch does not say whether its tensors change."""
    lights = parts.normals if parts is not None and type(parts.normals) is NormalFromIntensity else None
    if lights is not None:
        lights.follow_lights()
    modules = [module for module in pipe.modules() if module is not pipe]
    tensors = [*pipe.parameters(), *pipe.buffers()]
    if any(tensor.is_inference() for tensor in tensors):
        return None
    hooks = [module.__dict__[name] for module in modules for name in HOOKS]
    sizes = [module.__dict__ for module in (pipe, *modules)] + hooks + [module._modules for module in modules]
    entries = [entry for module in (pipe, *modules) for entry in _entries(module)]
    made, first = None, []
    if parts is not None and not any(hooks) and _all_own(parts):
        buffers = _buffers(parts)
        first = [buffers[name] for name in OF_FIRST_STAGE if name in buffers]
        with torch.inference_mode(False), torch.no_grad():
            made = _prepare(parts, buffers, _settings(parts))
    return _Prepared(
        None if made is None else made[0],
        () if made is None else (1, 3, made[0].height, made[0].width),
        kernels.loaded(),
        lights,
        [] if made is None else made[1],
        first,
        [tensor.data_ptr() for tensor in first],
        tensors,
        [tensor.data_ptr() for tensor in tensors],
        [tensor._version for tensor in tensors],
        modules,
        list(map(type, modules)),
        sizes,
        list(map(len, sizes)),
        [place for place, _ in entries],
        [name for _, name in entries],
        [place[name] for place, name in entries],
    )


def _entries(module: nn.Module) -> list[tuple[dict[str, Any], str]]:
    """Where the settings of a module stand, and its tensors and modules."""
    settings: dict[str, Any] = module.__dict__
    entries = [(settings, name) for name in settings if name not in OF_MODULES]
    for inner in (module._parameters, module._buffers, module._modules):
        entries += [(inner, name) for name in inner]
    return entries


def _run(kernel: Callable[..., int], program: Program, images: Tensor, threads: int) -> DepthOutput | None:
    """None where an image is not in [0, 1], and where a frame needs what the program cannot do."""
    count, _, height, width = images.shape
    maps = [((count, channels, height, width), torch.float32) for channels in (1, 2, 3)]
    mask = (count, 1, height, width), torch.bool
    out = DepthOutput(*empties([*maps, mask, mask]))
    at, pixels = ctypes.byref(program), height * width
    image, depth, gradient, normal, contact, deformed = (tensor.data_ptr() for tensor in (images, *out))

    def some(first: int, many: int) -> int:
        place = 4 * pixels * first
        rest = (depth + place, gradient + 2 * place, normal + 3 * place, contact + pixels * first, deformed + pixels * first)
        return kernel(at, image + 3 * place, many, threads, *rest)

    trouble = by_frames(count, pixels, some)
    if trouble == 1:
        raise MemoryError("torchvts: no memory is left for a frame")
    return None if trouble else out


def _all_own(parts: Blocks) -> bool:
    """Whether all blocks are the library's own, as they were made."""
    compensate: Any = parts.compensate
    if not all(map(_own, parts, OWN)) or parts.passes > 2 or not parts.crop.enabled:
        return False
    if type(parts.normals) is NormalFromIntensity and (parts.passes > 1 or parts.normals.lights.glossy):
        return False
    inner = compensate._modules
    if len(inner["linear"]) or compensate.saturates or not all(_own(block, (FillDefects, Blur)) for block in inner["clean"]):
        return False
    drift = inner["drift"]
    return _own(drift, (nn.Identity, Drift)) and (type(drift) is not Drift or drift.background is None or drift.by_mode_first)


def _own(block: Any, kinds: tuple[type, ...]) -> bool:
    return type(block) in kinds and (block is None or "forward" not in block.__dict__)


def _buffers(parts: Blocks) -> dict[str, Tensor]:
    """All tensors that the result depends on."""
    compensate: Any = parts.compensate
    gain, mask, normals = compensate.gain._buffers, parts.deformed._buffers, parts.normals._buffers
    found = {"gain": gain["gain"], "offset": gain["offset"], "flat": mask["offset"]}
    found.update({name: mask[name] for name in ("per_noise", "failed_below", "most_far_field")})
    for block in compensate._modules["clean"]:
        found.update(block._buffers)  # defects
    if "maps" in normals:
        found.update(normals)
    else:
        model: Any = parts.normals
        shadowed = model.shadowed._buffers
        found.update(inverse=normals["inverse"], noise=shadowed["noise_std"], lit=shadowed["flat"])
        found.update(saturated=shadowed["saturated_above"])
        found.update(position=model.lights.position_mm, albedo=model.lights.albedo)
    return {name: buffer for name, buffer in found.items() if buffer is not None}


def _settings(parts: Blocks) -> dict[str, Any]:
    """All numbers that the result depends on, by their names in :class:`Program`; and the weights of the blur."""
    compensate: Any = parts.compensate
    mask: Any = parts.deformed
    normals, gradient, integrate, zero, slopes, contact = (getattr(parts, name) for name in _WITH_NUMBERS)
    zeroes, drift = type(zero) is ZeroBackground, compensate._modules["drift"]
    return {
        "weights": next((block.weights for block in compensate._modules["clean"] if type(block) is Blur), ()),
        "drifts": type(drift) is Drift,
        "believed_drift": MOST_BY_MODE if getattr(drift, "background", None) is not None else math.inf,
        "step": mask.step,
        "stride": mask.stride,
        "cell": mask.cell,
        "reach": mask.reach,
        "bridge": mask.bridge_cells,
        "sigmas": mask.sigmas,
        "rounding": mask.rounding,
        "least_cells": mask.least_cells,
        "bridge_sigmas": mask.bridge_sigmas,
        "tail_sigmas": mask.tail_sigmas,
        "least_spread": mask.least_spread,
        "least_colour": mask.least_colour,
        "corners": parts.crop.stride,
        "max_sine": getattr(normals, "max_sine", 0.0),
        "steeper": getattr(normals, "steeper", 0.0),
        "reference_mm": getattr(normals, "reference_mm", 0.0),
        "per_slope": 1.0 / gradient.max_slope,
        "pitch": integrate.mm_per_pixel,
        "passes": parts.passes,
        "zeroes": zeroes,
        "sweeps": zero.sweeps if zeroes else 0,
        "stiff": zero.stiff if zeroes else 0.0,
        "tolerance": zero.tolerance if zeroes else 0.0,
        "slopes_of_depth": slopes is not None,
        "half_per_mm": 0.0 if slopes is None else 0.5 / slopes.mm_per_pixel,
        "contact_cell": contact.cell,
        "contact_reach": contact.reach,
        "contact_model": contact.numbers(),
    }


_WITH_NUMBERS = ("normals", "gradient", "integrate", "zero", "slopes", "contact")


def _prepare(parts: Blocks, buffers: dict[str, Tensor], settings: dict[str, Any]) -> tuple[Program, list[Any]] | None:
    """The program, and what holds the memory that it points to."""
    if not usable(*(buffer for buffer in buffers.values() if buffer.is_floating_point())):
        return None
    compensate: Any = parts.compensate
    mask: Any = parts.deformed
    normals: Any = parts.normals
    height, width = mask.flat.shape[1], mask.flat.shape[2]
    tables = kernels.poisson_plan(height, width) if min(height, width) > 1 else None
    if tables is None or any(
        field.shape[-2:] != (height, width) for name, field in buffers.items() if name in ("gain", "offset", "inverse", "maps")
    ):
        return None
    tensors = {name: buffer.contiguous() for name, buffer in buffers.items()}
    if "maps" in tensors:
        lines = response_lines(normals)
        if lines is None or lines.per_mm is None:
            return None
        tensors.update(place=lines.place, weight=lines.weight, per_mm=lines.per_mm)
        settings = settings | {"degree": lines.weight.shape[1] - 1, "terms": lines.weight.shape[3]}
    elif normals.shadowed.any_ill_conditioned:
        return None
    if flat_is_one(mask):
        del tensors["flat"]
    found = pedestals(compensate.gain) if "gain" in tensors and "offset" in tensors else None
    if found is not None:
        del tensors["offset"]
    smooth = kernels.smooth_tables(height, width) if type(parts.smooth) is SmoothDrift else None
    weights = (REAL * len(settings["weights"]))(*settings["weights"])
    pointers = {name: tensor.data_ptr() for name, tensor in tensors.items() if name in _POINTERS}
    program = Program(
        **{name: value for name, value in settings.items() if name != "weights"},
        **pointers,
        weights=ctypes.addressof(weights),
        tables=tables.data_ptr(),
        smooth=None if smooth is None else ctypes.addressof(smooth.structure),
        height=height,
        width=width,
        taps=len(weights),
        defects=len(tensors["defect"]) if "defect" in tensors else 0,
        pedestal=kernels.NO_PEDESTAL if found is None else found,
        drift_stride=stride_of(height, width),
        halvings=HALVINGS,
        least_drift=LEAST_DRIFT,
        most_drift=MOST_DRIFT,
    )
    return program, [tensors, buffers, weights, tables, smooth]


_POINTERS = {field[0] for field in Program._fields_ if field[1] is POINTER}
