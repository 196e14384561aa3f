"""Response fields: inclination of the skin as a polynomial in the change of intensity whose coefficients vary over the image."""

import dataclasses
import math
from dataclasses import dataclass
from itertools import combinations_with_replacement
from typing import Any, TypeVar

import torch
from torch import Tensor

from ..core.checks import brief, check_integer, check_least, check_numbers, check_positive, check_record, check_sequence, from_dict
from ..core.geometry import pixel_grid_mm

_Kind = TypeVar("_Kind", bound="_Coefficients")

CHANGE_SCALE = 0.3
"""Relative change of intensity that counts as one, so that the inputs are of order one."""

MAX_SLOPE = 3.0
"""Largest steepness that a field gives, mm per mm: polynomials run away outside of what they were fitted on."""

MAX_SINE = math.sin(math.atan(MAX_SLOPE))

PRIOR_VERSION = 2
"""Version of a prior in a sensor file. One of another version is refused."""


class Terms:
    """The terms of a field, by the degrees in position of its linear terms and of its products of two and of three."""

    degree: int
    product_degree: int
    cubic_degree: int

    def degrees(self) -> dict[tuple[int, ...], int]:
        """Degree in position of every term, in order."""
        return term_degrees_by_term(self.degree, self.product_degree, self.cubic_degree)

    def size(self) -> int:
        """Number of coefficients of one slope."""
        return sum(map(monomials, self.degrees().values()))


class _Coefficients:
    """Coefficients of :func:`position_basis`, which files hold as plain numbers."""

    half_mm: float
    coefficient: tuple[tuple[float, ...], ...]

    def _keep(self, rows: int, size: int) -> None:
        """Check and keep the numbers that every subclass has."""
        object.__setattr__(self, "half_mm", check_positive("half_mm", self.half_mm))
        numbers = check_numbers("coefficient", self.coefficient, (rows, size))
        object.__setattr__(self, "coefficient", tuple(numbers[k * size : (k + 1) * size] for k in range(rows)))

    def tensor(self) -> Tensor:
        """The coefficients, (rows, size) float64."""
        return torch.tensor(self.coefficient, dtype=torch.float64)

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, to seven digits, which is more than presses determine."""
        rows = [[float(f"{number:.7g}") for number in row] for row in self.coefficient]
        plain: dict[str, Any] = dataclasses.asdict(self)  # type: ignore[call-overload]
        return plain | {"coefficient": rows}

    @classmethod
    def from_dict(cls: type[_Kind], values: Any, source: str) -> _Kind:
        """Read the output of :meth:`to_dict`; ``source`` names it in errors."""
        return from_dict(cls, values, source)


@dataclass(frozen=True)
class ResponseField(Terms, _Coefficients):
    r"""sine(x, y) = sum over terms of W_t(x, y) * term_t(change).

    The sine is ``slope / sqrt(1 + |slope|^2)``, the part of the unit normal that lies in the plane of the undeformed skin: the
    light on a matt skin is linear in its normal, not in its slope. The inputs are the relative changes of R, G and B,
    image / background - 1, divided by :data:`CHANGE_SCALE`. The terms are the inputs and, if their degree is not -1, the products
    of two and of three of them. No term is constant: the undeformed skin has slope zero. Each W_t is a polynomial in x / half_mm
    and y / half_mm, of total degree ``degree``, ``product_degree`` or ``cubic_degree``.

    Args:
        degree: of the linear terms, 0 to 6.
        product_degree: of the products, 0 to 6; -1 for no products.
        half_mm: scale of positions, mm: half the width of the field of view.
        coefficient: 2 rows (along x, along y) of :meth:`size` numbers, term after term.
        cubic_degree: of the products of three, 0 to 6; -1 for none.
    Raises:
        ValueError, TypeError: names the argument.
    Source:
        linear slope response: Johnson and Adelson, CVPR 2009, who tabulate it.
    Example:
        >>> ResponseField(0, -1, 10.0, ((1, 0, 0), (0, 1, 0))).size()
        3
    """

    degree: int
    product_degree: int
    half_mm: float
    coefficient: tuple[tuple[float, ...], ...]
    cubic_degree: int = -1

    def __post_init__(self) -> None:
        for name, least in (("degree", 0), ("product_degree", -1), ("cubic_degree", -1)):
            if check_integer(name, getattr(self, name), least) > 6:
                raise ValueError(f"{name}: expected at most 6, got {getattr(self, name)}")
        self._keep(2, self.size())

    def terms(self) -> list[tuple[int, ...]]:
        """Terms as indices of their inputs: (0,) is the change of R, (0, 2) that change times the change of B."""
        return list(self.degrees())

    def maps(self, height: int, width: int, mm_per_pixel: float) -> Tensor:
        """W at every pixel: (terms, 2, H, W) float64."""
        weight, start = self.tensor(), 0
        maps = []
        for degree in self.degrees().values():
            basis = image_basis(height, width, mm_per_pixel, self.half_mm, degree)
            maps.append(torch.tensordot(weight[:, start : start + len(basis)], basis, 1))
            start += len(basis)
        return torch.stack(maps)

    def embedded(self, degree: int, product_degree: int, cubic_degree: int = -1) -> "ResponseField":
        """The same field as a member of a larger family; the new coefficients are zero.

        Raises:
            ValueError: the family is not larger.
        """
        new = term_degrees_by_term(degree, product_degree, cubic_degree)
        old = self.degrees()
        if any(term not in new or new[term] < d for term, d in old.items()):
            raise ValueError(f"degree, product_degree, cubic_degree: expected a family that holds {old}, got {new}")
        known = [dict(zip(powers(old), row, strict=True)) for row in self.coefficient]
        rows = tuple(tuple(row.get(key, 0.0) for key in powers(new)) for row in known)
        return ResponseField(degree, product_degree, self.half_mm, rows, cubic_degree)


@dataclass(frozen=True)
class DepthBrightness(_Coefficients):
    """What depth does to brightness: the skin comes nearer to the lights.

    A flat skin at depth z changes its relative brightness by c(x, y) z. Beyond a reference depth, at which the field holds, a slope
    changes it ``1 + steeper (z - reference_mm)`` times as much, since lights shine flatter on a skin that lies higher.

    Args:
        degree: of c in position, 0 to 2.
        half_mm: scale of positions, mm.
        coefficient: of c, 3 rows (R, G, B) of coefficients of :func:`position_basis`, 1 / mm.
        steeper: 1 / mm, at least 0.
        reference_mm: depth up to which the field holds as it is, mm, at least 0.
    Raises:
        ValueError, TypeError: names the argument.
    Source:
        eq. 1 of the paper: a light at height h and distance d gives c = 3 h / d^2 - 1 / h and steeper = 3 h / d^2.
    Example:
        >>> DepthBrightness(0, 10.0, ((0.1,), (0.0,), (0.0,))).maps(2, 2, 0.1)[:, 0, 0]
        tensor([0.1000, 0.0000, 0.0000], dtype=torch.float64)
    """

    degree: int
    half_mm: float
    coefficient: tuple[tuple[float, ...], ...]
    steeper: float = 0.0
    reference_mm: float = 0.0

    def __post_init__(self) -> None:
        if check_integer("degree", self.degree, 0) > 2:
            raise ValueError(f"degree: expected at most 2, got {self.degree}")
        for name in ("steeper", "reference_mm"):
            object.__setattr__(self, name, check_least(name, getattr(self, name)))
        self._keep(3, monomials(self.degree))

    def maps(self, height: int, width: int, mm_per_pixel: float) -> Tensor:
        """The change at every pixel, (3, H, W) float64, 1 / mm."""
        maps: Tensor = torch.tensordot(self.tensor(), image_basis(height, width, mm_per_pixel, self.half_mm, self.degree), 1)
        return maps


@dataclass(frozen=True)
class ResponseModel:
    """Response of a sensor: a field, what depth alone does to brightness, and the preprocessing of images.

    Args:
        field: sine by brightness.
        by_depth: applied to the change of brightness in a second pass, with the depth of the first; None if not known.
        gamma: of the images it was fitted to, value = light^(1/gamma).
        blur_px: standard deviation of the Gaussian blur it was fitted with, pixels of the calibrated size.
    Raises:
        ValueError, TypeError: names the argument.
    """

    field: ResponseField
    by_depth: DepthBrightness | None
    gamma: float = 1.0
    blur_px: float = 1.0

    def __post_init__(self) -> None:
        check_record("field", self.field, ResponseField)
        if self.by_depth is not None and not isinstance(self.by_depth, DepthBrightness):
            raise TypeError(f"by_depth: expected a DepthBrightness or None, got {brief(self.by_depth)}")
        object.__setattr__(self, "gamma", check_positive("gamma", self.gamma, 10.0))
        if self.blur_px != 0:
            check_positive("blur_px", self.blur_px)
        object.__setattr__(self, "blur_px", float(self.blur_px))

    @classmethod
    def zero(cls, gamma: float = 1.0, blur_px: float = 1.0) -> "ResponseModel":
        """A model whose slope is zero everywhere: for preprocessing before a model is fitted."""
        return cls(ResponseField(0, -1, 1.0, ((0.0,) * 3, (0.0,) * 3)), None, gamma, blur_px)

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers."""
        by_depth = None if self.by_depth is None else self.by_depth.to_dict()
        return {"gamma": self.gamma, "blur_px": self.blur_px, "field": self.field.to_dict(), "by_depth": by_depth}

    @classmethod
    def from_dict(cls, values: Any, source: str) -> "ResponseModel":
        """Read the output of :meth:`to_dict`; ``source`` names it in errors."""
        return from_dict(cls, values, source, {"field": ResponseField.from_dict, "by_depth": DepthBrightness.from_dict})


def sine_from_slope(slope: Tensor) -> Tensor:
    """slope / sqrt(1 + |slope|^2) of slopes (2, N)."""
    return slope / (1.0 + slope.square().sum(0)).sqrt()


def slope_from_sine(sine: Tensor) -> Tensor:
    """The slopes of sines (2, N); a sine beyond that of :data:`MAX_SLOPE` counts as that: polynomials run away."""
    length = sine.square().sum(0).sqrt().clamp_min(1e-12)
    kept = sine * (MAX_SINE / length).clamp_max(1.0)
    return kept / (1.0 - kept.square().sum(0)).sqrt()


@dataclass(frozen=True)
class SensorPrior:
    """Response of the units of a sensor type: a Gaussian of the field's coefficients, and the background it was fitted with.

    The mean is the field of ``response``. The precision says how little units differ from it, as a number of presses
    (torchvts/calibration/posterior.py).

    Args:
        response: the model.
        log_background: (3, 15), R, G, B: coefficients of :func:`position_basis` of degree 4 that give log(background).
        half_mm: scale of the positions of ``log_background``, mm.
        source: whose images it was fitted to, and how.
        held_out_deg: mean angle between its normals and those of balls that it was not fitted to, degrees, of each unit that it was
            tried on: first the unit it was fitted to, by other presses, then other units. Empty where nobody has measured it.
        own_deg: mean error on the balls that it was fitted to, degrees; None where nobody has measured it.
        power: mean square of the changes of light in their contacts, in units of :data:`CHANGE_SCALE`, of the three channels.
        precision: of a constant linear coefficient among units, in presses.
    Raises:
        ValueError, TypeError: names the argument.
    """

    response: ResponseModel
    log_background: tuple[tuple[float, ...], ...]
    half_mm: float
    source: str
    held_out_deg: tuple[float, ...] = ()
    own_deg: float | None = None
    power: float = 2.0
    precision: float = 0.1

    def __post_init__(self) -> None:
        check_record("response", self.response, ResponseModel)
        numbers = check_numbers("log_background", self.log_background, (3, 15))
        object.__setattr__(self, "log_background", (numbers[:15], numbers[15:30], numbers[30:]))
        object.__setattr__(self, "half_mm", check_positive("half_mm", self.half_mm))
        if not isinstance(self.source, str):
            raise TypeError(f"source: expected a text, got {brief(self.source)}")
        check_sequence("held_out_deg", self.held_out_deg, "degrees, one per unit")
        angles = tuple(check_positive("held_out_deg", angle, 90.0) for angle in self.held_out_deg)
        object.__setattr__(self, "held_out_deg", angles)
        if self.own_deg is not None:
            object.__setattr__(self, "own_deg", check_positive("own_deg", self.own_deg, 90.0))
        for name in ("power", "precision"):
            object.__setattr__(self, name, check_positive(name, getattr(self, name)))

    @property
    def expected_deg(self) -> float | None:
        """Mean error of normals to expect of a unit of this type by its background, degrees; None where it is not measured."""
        return sum(self.held_out_deg) / len(self.held_out_deg) if self.held_out_deg else None

    def background(self, height: int, width: int, mm_per_pixel: float) -> Tensor:
        """The smooth background of the unit it was fitted to, (3, H, W) float64, linear light."""
        basis = image_basis(height, width, mm_per_pixel, self.half_mm, 4)
        log_light: Tensor = torch.tensordot(torch.tensor(self.log_background, dtype=torch.float64), basis, 1)
        return log_light.exp()

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers."""
        rows = [[float(f"{number:.6g}") for number in row] for row in self.log_background]
        measured: dict[str, Any] = {}
        if self.held_out_deg:
            measured["held_out_deg"] = [float(f"{angle:.3g}") for angle in self.held_out_deg]
        if self.own_deg is not None:
            measured["own_deg"] = float(f"{self.own_deg:.3g}")
        measured |= {"power": float(f"{self.power:.3g}"), "precision": self.precision}
        source: dict[str, Any] = {"version": PRIOR_VERSION, "source": self.source}
        return source | measured | {"half_mm": self.half_mm, "log_background": rows, "response": self.response.to_dict()}

    @classmethod
    def from_dict(cls, values: Any, source: str) -> "SensorPrior":
        """Read the output of :meth:`to_dict`; ``source`` names it in errors."""
        if isinstance(values, dict):
            values = dict(values)
            if (version := values.pop("version", None)) != PRIOR_VERSION or isinstance(version, bool):
                raise ValueError(
                    f"{source}: expected version {PRIOR_VERSION} of a prior, got {brief(version)}: written by another torchvts; "
                    "fit it again with scripts/fit_prior.py, or update torchvts"
                )
        return from_dict(cls, values, source, {"response": ResponseModel.from_dict})


def term_degrees_by_term(degree: int, product_degree: int, cubic_degree: int = -1) -> dict[tuple[int, ...], int]:
    """Degree in position of every term, in order: the three changes, then their products of two, and of three."""
    orders = enumerate((degree, product_degree, cubic_degree), start=1)
    return {term: d for order, d in orders if d >= 0 for term in combinations_with_replacement(range(3), order)}


def powers(degrees: dict[tuple[int, ...], int]) -> list[tuple[tuple[int, ...], int, int]]:
    """Of every coefficient, in order: its term, and the powers of x and of y."""
    return [(term, i, j) for term, degree in degrees.items() for i in range(degree + 1) for j in range(degree + 1 - i)]


def monomials(degree: int) -> int:
    """Number of monomials of two variables up to a total degree."""
    return (degree + 1) * (degree + 2) // 2


def position_basis(x: Tensor, y: Tensor, half_mm: float, degree: int) -> Tensor:
    """Monomials of total degree up to ``degree`` in x / half_mm, y / half_mm: (n, *x.shape)."""
    u, v = x / half_mm, y / half_mm
    columns, rows = [torch.ones_like(u)], [torch.ones_like(v)]
    for _ in range(degree):
        columns.append(columns[-1] * u)
        rows.append(rows[-1] * v)
    return torch.stack([columns[i] * rows[j] for i in range(degree + 1) for j in range(degree + 1 - i)])


def image_basis(height: int, width: int, mm_per_pixel: float, half_mm: float, degree: int) -> Tensor:
    """:func:`position_basis` at every pixel of an image, (n, H, W) float64."""
    x, y = pixel_grid_mm(height, width, mm_per_pixel, torch.float64)
    return position_basis(x.expand(height, width), y.expand(height, width), half_mm, degree)


def term_values(change: Tensor, x: Tensor, y: Tensor, half_mm: float, degrees: dict[tuple[int, ...], int]) -> Tensor:
    """Factor of every coefficient, (size, N), at N places, mm, for changes of light (3, N) and :func:`term_degrees_by_term`."""
    inputs = change / CHANGE_SCALE
    bases = {degree: position_basis(x, y, half_mm, degree) for degree in set(degrees.values())}
    products = {term: math.prod([inputs[k] for k in term[1:]], start=inputs[term[0]]) for term in degrees}
    return torch.cat([products[term] * bases[degree] for term, degree in degrees.items()])
