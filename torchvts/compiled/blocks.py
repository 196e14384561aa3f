"""What the compiled stages need of each block of a pipeline. What has no compiled form is refused by name."""

import inspect
import math
from typing import Any, TypeVar, cast

import torch
from torch import Tensor, nn

from ..compensate import AsItIs, Compensate, Relight
from ..compensate.compensate import Blur, Gain, Linearise
from ..compensate.defects import FillDefects
from ..core.blur import gaussian_weights
from ..core.cells import whole_cell_means
from ..core.geometry import CLIFF_SLOPE, MAX_SLOPE, GradientFromNormal
from ..integration import PoissonBackground, PoissonDCT
from ..model import FillMarkers
from ..normals import NormalFromIntensity, NormalFromResponse
from ..normals import shadowed as shadowed_module
from ..normals.base import WrappedNormals
from ..skin import ContactFromDepth, ContactMask, ZeroBackground
from ..skin import pressure as pressure_module
from ..skin import weight as weight_module
from ..skin import zero as zero_module
from .plan import Values, fields

_Block = TypeVar("_Block", bound=nn.Module)

LIGHTS = 8193
"""Values of a camera whose light stands in a table: between them light^2.2 is a line to 5e-9."""

DEGREES = (2, 4, 6)
"""Degrees for which response.c has loops."""


class NotCompiled(Exception):
    """What has no compiled form, in words."""


def check_block(name: str, block: object, *kinds: type[_Block]) -> _Block:
    """The block, if it is one of these classes, as the library has it: no subclass, no method replaced, no hook.

    Raises:
        NotCompiled: names the block and what is its own.
    """
    kind = type(block)
    if kind not in kinds:
        own = type(block.module) if isinstance(block, WrappedNormals) else kind
        raise NotCompiled(f"{name} is {own.__name__}")
    for key, value in vars(block).items():
        if callable(getattr(kind, key, None)):
            raise NotCompiled(f"{name}.{key} is replaced")
        if isinstance(value, dict) and any(callable(one) and not isinstance(one, nn.Module) for one in value.values()):
            raise NotCompiled(f"{name} has a hook")
    for parent in inspect.getmro(kind):
        for key, value in vars(parent).items() if parent.__module__.startswith("torchvts.") else ():
            if inspect.isfunction(value) and not value.__module__.startswith("torchvts."):
                raise NotCompiled(f"{name}.{key} is replaced")
    return cast(_Block, block)


def check_equal(name: str, value: object, expected: object) -> None:
    """Raise unless a setting has the only value that the compiled stages know."""
    if value != expected:
        raise NotCompiled(f"{name} is {value!r:.60}, not {expected!r:.60} as elsewhere in the pipeline")


def _map(name: str, value: Any, size: tuple[int, int]) -> Any:
    """A map (C, H, W) of the size, or None for none; one of a single pixel is spread over it."""
    if value is None:
        return None
    if value.shape[-2:] == (1, 1):
        value = value.expand(*value.shape[:-2], *size)
    if tuple(value.shape[-2:]) != size:
        raise NotCompiled(f"{name} is of another size, {tuple(value.shape[-2:])}")
    return value


def _floats(values: object, dtype: torch.dtype = torch.float32) -> Tensor:
    return torch.as_tensor(values, dtype=dtype)


def _same(block: nn.Module, *names: str) -> Values:
    """Fields that a block holds under their names."""
    return {name: getattr(block, name) for name in names}


def compensate_values(block: nn.Module, size: tuple[int, int]) -> Values:
    """Of :class:`Compensate`."""
    block = check_block("compensate", block, Compensate)
    gain = check_block("compensate.gain", block.gain, Gain)
    steps = _steps("compensate.clean", block.clean, FillDefects, Blur)
    fill, blur = steps.get(FillDefects), steps.get(Blur)
    none = torch.zeros(0, dtype=torch.int64)
    weights = [] if blur is None or blur.std_px == 0.0 else blur.weights
    values: Values = _light_values(block.linear) | {
        "gain": _map("compensate.gain.gain", gain.gain, size),
        "pedestal": _pedestals(gain),
        "defect": none if fill is None else fill.defect,
        "neighbours": none if fill is None else fill.neighbours,
        "defects": 0 if fill is None else fill.defect.shape[0],
        "blur": _floats(weights),
        "blur_taps": len(weights),
    }
    return values | _relight_values(block.relight, size)


def _light_values(linear: nn.ModuleList) -> Values:
    """What fills markers, and the light of camera values as a table."""
    values: Values = dict.fromkeys(_MARKERS, 0.0) | {"exponent": 1.0, "light_of": None, "lights": 0}
    steps = _steps("compensate.linear", linear, FillMarkers, Linearise)
    if (fill := steps.get(FillMarkers)) is not None:
        values |= {field: getattr(fill, name) for field, name in _MARKERS.items()}
    if (linearise := steps.get(Linearise)) is not None:
        light = linearise(torch.linspace(0.0, 1.0, LIGHTS, dtype=torch.float64)).float()
        values |= {"exponent": linearise.gamma, "light_of": light, "lights": LIGHTS}
    return values


def _steps(name: str, steps: nn.ModuleList, *kinds: type[nn.Module]) -> dict[type, Any]:
    """Steps by their class: of these classes, each once at most, in this order."""
    found = [type(step) for step in steps]
    if found != [kind for kind in kinds if kind in found]:
        raise NotCompiled(f"{name} is {', '.join(kind.__name__ for kind in found)}")
    for k, step in enumerate(steps):
        check_block(f"{name}.{k}", step, *kinds)
    return dict(zip(found, steps, strict=True))


_MARKERS = {f"marker_{name.removesuffix('_px')}": name for name in FillMarkers().to_dict()}


def _pedestals(block: Gain) -> Tensor:
    """What is added to each channel before the gain, (3,)."""
    if block.offset is None:
        return torch.zeros(3, dtype=torch.float32)
    before = block.offset.double() / (1.0 if block.gain is None else block.gain.double())
    found = before.flatten(1).mean(dim=1)
    if float((before - found[:, None, None]).abs().max()) > 1e-6:
        raise NotCompiled("compensate.gain.offset is no number of each channel times the gain")
    return found.float()


def _relight_values(block: nn.Module, size: tuple[int, int]) -> Values:
    check_block("compensate.relight", block, Relight, AsItIs)
    relights = isinstance(block, Relight) and block.shows
    source = block if isinstance(block, Relight) else Relight(torch.ones(3, *size))
    check_equal("compensate.relight.size", source.size, size)
    rows, columns = source.sampled.shape[1:]
    pad = [0, -rows * columns % 8]
    return {
        "relights": relights,
        "relight_stride": source.stride,
        "relight_rows": rows,
        "relight_columns": columns,
        "relight_padded": rows * columns + pad[1],
        "relight_every": source.every,
        "relight_steps": len(source.scales),
        "background": source.background,
        "relight_skin": source.sampled,
        "relight_share": nn.functional.pad(source.share, pad).double(),
        "relight_place": nn.functional.pad(source.place, pad).double(),
        "relight_terms": source.to_terms.double(),
        "relight_scales": _floats(source.scales, torch.float64),
        "along_x": source.x[1:],
        "along_y": source.y[1:],
        "lost": source.most_lost,
        "least_light": source.least,
    } | _same(source, "saturation_light", "black", "alike", "exact", "damping", "better")


def normals_values(name: str, model: nn.Module, gradient: nn.Module) -> Values:
    """Of a model of normals and the slopes of its normals: size, pitch, lights or response field.

    Raises:
        NotCompiled: another model, a glossy skin, or maps that are no polynomials.
    """
    check_block(name, model, NormalFromIntensity, NormalFromResponse)
    gradient = check_block("solve.gradient", gradient, GradientFromNormal)
    # of the other model: no tables, and numbers that nothing reads
    values: Values = {field: 0 if fields()[field][0] in ("i", "d") else None for field in _LIGHTS + _RESPONSE}
    values["max_slope"] = gradient.max_slope
    if isinstance(model, NormalFromIntensity):
        return values | _lights_values(name, model)
    assert isinstance(model, NormalFromResponse)
    return values | _response_values(name, model)


_LIGHTS = (
    "by_lights", "inverse", "flat_light", "saturated_above", "ill_conditioned", "any_ill_conditioned", "position", "albedo",
    "noise_std", "prior_std", "brightness_noises", "least_brightness",
    "shadow_steps", "cliff_slope", "start_slope", "failed_share",
)  # fmt: skip
_RESPONSE = ("field_place", "field", "degree", "terms", "per_mm", "steeper", "reference_mm", "max_sine")


def _lights_values(name: str, model: NormalFromIntensity) -> Values:
    if model.lights.glossy:
        raise NotCompiled(f"{name}.lights are glossy")
    check_equal(f"{name}.camera_height_mm", model.camera_height_mm, math.inf)
    model.follow_lights()
    shadowed = check_block(f"{name}.shadowed", model.shadowed, shadowed_module.ShadowedPixels)
    height, width = (int(n) for n in model.inverse.shape[2:])
    return {
        "height": height,
        "width": width,
        "mm_per_pixel": model.mm_per_pixel,
        "by_lights": 1,
        "inverse": model.inverse,
        "flat_light": _map(f"{name}.shadowed.flat", shadowed.flat, (height, width)),
        "saturated_above": _map(f"{name}.shadowed.saturated_above", shadowed.saturated_above, (height, width)),
        "ill_conditioned": shadowed.ill_conditioned,
        "any_ill_conditioned": shadowed.any_ill_conditioned,
        "position": model.lights.position_mm,
        "albedo": model.lights.albedo,
        "noise_std": shadowed.noise_std,
        "prior_std": shadowed_module.PRIOR_STD,
        "shadow_steps": shadowed_module.SLOPE_STEPS,
        "cliff_slope": CLIFF_SLOPE,
        "start_slope": MAX_SLOPE,
        "failed_share": shadowed_module.FAILED_SHARE,
    } | _same(shadowed, "brightness_noises", "least_brightness")


def _response_values(name: str, model: NormalFromResponse) -> Values:
    maps, per_mm = model.maps, model.per_mm
    place = torch.linspace(-1.0, 1.0, maps.shape[3], dtype=torch.float64)
    field = next((found for degree in DEGREES if (found := _polynomials(maps, place, degree)) is not None), None)
    by_depth = _polynomials(per_mm, place, 2)
    if field is None or by_depth is None:
        raise NotCompiled(f"{name} has maps that are no polynomials along rows")
    check_equal(f"{name}.maps", maps.shape[0], len(model.terms))
    return {
        "height": int(maps.shape[2]),
        "width": int(maps.shape[3]),
        "mm_per_pixel": None,
        "field_place": place.float(),
        "field": field.permute(2, 3, 1, 0).float(),
        "degree": field.shape[3] - 1,
        "terms": maps.shape[0],
        "per_mm": by_depth.transpose(0, 1).float() if model.uses_depth else None,
    } | _same(model, "steeper", "reference_mm", "max_sine")


def _polynomials(maps: Tensor, place: Tensor, degree: int) -> Tensor | None:
    """Coefficients (..., H, degree + 1) of maps (..., H, W) along their rows; None where they are no such polynomials."""
    powers = place[:, None] ** torch.arange(degree + 1, dtype=torch.float64)
    found: Tensor = maps.double() @ torch.linalg.pinv(powers).t()
    if maps.numel() and not float((found @ powers.t() - maps).abs().max()) <= 3e-7 * float(maps.abs().max()):
        return None
    return found


def check_solver(name: str, block: nn.Module, mm_per_pixel: float) -> None:
    """Raise unless an integrator is the one that the library has; where its depth is zero does not matter, for that is found later.

    Raises:
        NotCompiled: another integrator, or another pitch.
    """
    check_block(name, block, PoissonDCT, PoissonBackground)
    check_equal(f"{name}.mm_per_pixel", block.mm_per_pixel, mm_per_pixel)


def mask_values(block: nn.Module, size: tuple[int, int], takes_slopes: bool) -> Values:
    """Of :class:`ContactMask`."""
    block = check_block("mask", block, ContactMask)
    cell = max(1, min(size) // block.cells)
    per_noise = whole_cell_means(_map("mask.per_noise", block.per_noise, size)[None], cell)
    return {
        "mask_cell": cell,
        "mask_flat": _map("mask.flat", block.flat, size),
        "per_light": _map("mask.per_light", block.per_light, size),
        "mask_noise": per_noise,
        "mask_blur": _floats(block.weights),
        "mask_taps": len(block.weights),
        "takes_slopes": takes_slopes,
        "rise_from": block.rise[0],
        "rise_to": block.rise[1],
        "failed_light": block.failed,
        "within": weight_module.WITHIN,
        "square_within": weight_module.SQUARE_WITHIN,
        "fewest": weight_module.FEWEST,
        "moved_depth": weight_module.LEAST_DEPTH,
    } | _same(block, "by_colour", "sigmas", "least_spread", "most_spread", "hanging", "rough", "grey_share")


def zero_values(block: nn.Module, size: tuple[int, int]) -> Values:
    """Of :class:`ZeroBackground`."""
    block = check_block("solve.zero", block, ZeroBackground)
    cell = max(1, min(size) // block.cells)
    h, w = size[0] // cell, size[1] // cell
    pitch, like = cell * block.mm_per_pixel, torch.zeros(0, dtype=torch.float64)
    k, m = zero_module.number_of_waves(h, w, block.waves)
    y, x = (zero_module.cosines(count, terms, count, like) for count, terms in ((h, k), (w, m)))
    along_y, along_x = (zero_module.slopes_of_cosines(count, terms, pitch, like) for count, terms in ((h, k), (w, m)))
    return {
        "zero_cell": cell,
        "waves_y": k,
        "waves_x": m,
        "cosine_y": y,
        "cosine_x": x,
        "pairs_y": _pairs(y),
        "pairs_x": _pairs(x).t(),
        "slope_pairs_y": _pairs(along_y),
        "slope_pairs_x": _pairs(along_x).t(),
        "pixel_y": zero_module.cosines(size[0], k, h * cell, like).float(),
        "pixel_x": zero_module.cosines(size[1], m, w * cell, like).float(),
        "by_pressure": zero_module.pressure_of_waves(k, m, (h, w), pitch, block.decay_mm, like),
        "zero_decay": (block.decay_mm / pitch) ** 2,
    } | _same(block, "face", "smooth_mm", "stiff", "pit", "pit_share")


def _pairs(lines: Tensor) -> Tensor:
    """Products of every two lines (n, length), each pair once: (n (n + 1) / 2, length)."""
    return torch.stack([lines[i] * lines[k] for i in range(len(lines)) for k in range(i, len(lines))])


def contact_values(block: nn.Module, size: tuple[int, int]) -> Values:
    """Of :class:`ContactFromDepth`."""
    block = check_block("contact", block, ContactFromDepth)
    cell = min(block.cell, *size)
    pitch = cell * block.mm_per_pixel
    weights = gaussian_weights(block.blur_mm / pitch)
    return {
        "contact_cell": cell,
        "contact_blur": _floats(weights),
        "contact_taps": len(weights),
        "curvature_scale": 1.0 / pitch**2,
        "contact_step": max(1, min(size[0] // cell, size[1] // cell) // pressure_module.CONTACT_SAMPLES),
        "contact_kink": block.kink * block.blur_mm**2,
        "contact_decay": block.decay_mm,
        "contact_by_frame": block.by_frame,
        "contact_steps": block.steps,
        "rim_reach": pressure_module.rim_reach(block.rim_mm, pitch),
    } | _same(block, "pull", "pulling", "least_deep", "share", "large", "deep", "fall", "least_depth")
