"""Response fields: slope of the skin as a polynomial in the change of intensity whose coefficients vary over the image."""

import dataclasses
import math
from dataclasses import dataclass
from itertools import combinations_with_replacement
from typing import Any

import torch
from torch import Tensor

from ..core.checks import brief, check_integer, check_numbers, check_positive, from_dict
from ..core.geometry import pixel_grid_mm

CHANGE_SCALE = 0.3
"""Relative change of intensity that counts as one, so that the inputs are of order one like depth in mm."""


@dataclass(frozen=True)
class ResponseField:
    r"""slope(x, y) = sum over terms of W_t(x, y) * term_t(change, depth).

    The inputs are the relative changes of R, G and B, image / background - 1, divided by :data:`CHANGE_SCALE`, and, if
    ``uses_depth``, the depth of a first pass in mm and its slopes along x and y. The terms are the inputs and, if
    ``product_degree`` is not -1, the products of two of changes and depth, except depth squared. No term is constant: the
    undeformed skin has slope zero. Each W_t is a polynomial of total degree ``degree`` (products: ``product_degree``) in
    x / half_mm and y / half_mm.

    The slopes of the depth have less noise than those of a single pixel, because integration keeps only what is the slope of a
    surface. The fit decides how much each of them counts.

    Args:
        degree: of the linear terms, 0 to 6.
        product_degree: of the products, 0 to 6; -1 for no products.
        uses_depth: depth and its slopes are inputs four to six.
        half_mm: scale of positions, mm: half the width of the field of view.
        coefficient: 2 rows (dz/dx, dz/dy) of :meth:`size` numbers, term after term.
    Raises:
        ValueError, TypeError: names the argument.
    Source:
        linear slope response: Johnson and Adelson, CVPR 2009, who tabulate it; as a polynomial field: this project.
    Example:
        >>> ResponseField(0, -1, False, 10.0, ((1, 0, 0), (0, 1, 0))).size()
        3
    """

    degree: int
    product_degree: int
    uses_depth: bool
    half_mm: float
    coefficient: tuple[tuple[float, ...], ...]

    def __post_init__(self) -> None:
        for name, least in (("degree", 0), ("product_degree", -1)):
            if check_integer(name, getattr(self, name), least) > 6:
                raise ValueError(f"{name}: expected at most 6, got {getattr(self, name)}")
        if not isinstance(self.uses_depth, bool):
            raise TypeError(f"uses_depth: expected true or false, got {brief(self.uses_depth)}")
        object.__setattr__(self, "half_mm", check_positive("half_mm", self.half_mm))
        numbers = check_numbers("coefficient", self.coefficient, (2, self.size()))
        object.__setattr__(self, "coefficient", (numbers[: self.size()], numbers[self.size() :]))

    def terms(self) -> list[tuple[int, ...]]:
        """Terms as indices of their inputs: (0,) is the change of R, (0, 3) that change times depth, (4,) dz/dx of the depth."""
        return field_terms(self.uses_depth, self.product_degree)

    def size(self) -> int:
        """Number of coefficients of one slope."""
        return len(term_degrees(self.degree, self.product_degree, self.uses_depth))

    def tensor(self) -> Tensor:
        """(2, size) float64."""
        return torch.tensor(self.coefficient, dtype=torch.float64)

    def maps(self, height: int, width: int, mm_per_pixel: float) -> Tensor:
        """W at every pixel: (terms, 2, H, W) float64, for slopes in mm per mm."""
        x, y = pixel_grid_mm(height, width, mm_per_pixel, torch.float64)
        x, y = x.expand(height, width), y.expand(height, width)
        weight, start = self.tensor(), 0
        maps = []
        for degree in term_degrees_by_term(self.degree, self.product_degree, self.uses_depth).values():
            basis = position_basis(x, y, self.half_mm, degree)
            maps.append(torch.tensordot(weight[:, start : start + len(basis)], basis, 1))
            start += len(basis)
        return torch.stack(maps)

    def embedded(self, degree: int, product_degree: int, uses_depth: bool) -> "ResponseField":
        """The same field as a member of a larger family; the new coefficients are zero.

        Raises:
            ValueError: the family is not larger.
        """
        new = term_degrees_by_term(degree, product_degree, uses_depth)
        old = term_degrees_by_term(self.degree, self.product_degree, self.uses_depth)
        if any(term not in new or new[term] < d for term, d in old.items()):
            raise ValueError(f"degree, product_degree, uses_depth: expected a family that holds {old}, got {new}")
        rows: list[tuple[float, ...]] = []
        for row in self.coefficient:
            numbers = iter(row)
            known = {(term, i, j): next(numbers) for term, d in old.items() for i in range(d + 1) for j in range(d + 1 - i)}
            rows.append(
                tuple(known.get((term, i, j), 0.0) for term, d in new.items() for i in range(d + 1) for j in range(d + 1 - i))
            )
        return ResponseField(degree, product_degree, uses_depth, self.half_mm, tuple(rows))

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, to seven digits, which is more than presses determine."""
        values = dataclasses.asdict(self)
        values["coefficient"] = [[float(f"{number:.7g}") for number in row] for row in self.coefficient]
        return values

    @classmethod
    def from_dict(cls, values: Any, source: str) -> "ResponseField":
        """Read the output of :meth:`to_dict`; ``source`` names it in errors."""
        return from_dict(cls, values, source)


@dataclass(frozen=True)
class ResponseModel:
    """Response of a sensor: a field for one pass, one for a second pass with depth, and the preprocessing of images.

    Args:
        fast: field without depth.
        precise: field that uses the depth by ``fast``, or None.
        gamma: of the images it was fitted to, value = light^(1/gamma).
        blur_px: standard deviation of the Gaussian blur it was fitted with, pixels of the calibrated size.
    Raises:
        ValueError, TypeError: names the argument.
    """

    fast: ResponseField
    precise: ResponseField | None
    gamma: float = 1.0
    blur_px: float = 1.0

    def __post_init__(self) -> None:
        if not isinstance(self.fast, ResponseField) or self.fast.uses_depth:
            raise ValueError("fast: expected a field that does not use depth")
        if self.precise is not None and not (isinstance(self.precise, ResponseField) and self.precise.uses_depth):
            raise ValueError("precise: expected a field that uses depth")
        object.__setattr__(self, "gamma", check_positive("gamma", self.gamma, 10.0))
        if self.blur_px != 0:
            check_positive("blur_px", self.blur_px)
        object.__setattr__(self, "blur_px", float(self.blur_px))

    @classmethod
    def zero(cls, gamma: float = 1.0, blur_px: float = 1.0) -> "ResponseModel":
        """A model whose slope is zero everywhere: for preprocessing before a model is fitted."""
        return cls(ResponseField(0, -1, False, 1.0, ((0.0,) * 3, (0.0,) * 3)), None, gamma, blur_px)

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers."""
        precise = None if self.precise is None else self.precise.to_dict()
        return {"gamma": self.gamma, "blur_px": self.blur_px, "fast": self.fast.to_dict(), "precise": precise}

    @classmethod
    def from_dict(cls, values: Any, source: str) -> "ResponseModel":
        """Read the output of :meth:`to_dict`; ``source`` names it in errors."""
        if not isinstance(values, dict):
            raise ValueError(f"{source}: expected keys and values, got {type(values).__name__}")
        values = dict(values)
        for name in ("fast", "precise"):
            if values.get(name) is not None:
                values[name] = ResponseField.from_dict(values[name], f"{source}: {name}")
        return from_dict(cls, values, source)


@dataclass(frozen=True)
class SensorPrior:
    """Response that all units of a sensor type share, and the background it was fitted with.

    Args:
        response: the model.
        log_background: (3, 15), R, G, B: coefficients of :func:`position_basis` of degree 4 that give log(background).
        half_mm: scale of the positions of ``log_background``, mm.
        source: whose images it was fitted to, and how.
    Raises:
        ValueError, TypeError: names the argument.
    """

    response: ResponseModel
    log_background: tuple[tuple[float, ...], ...]
    half_mm: float
    source: str

    def __post_init__(self) -> None:
        if not isinstance(self.response, ResponseModel):
            raise TypeError(f"response: expected a ResponseModel, got {type(self.response).__name__}")
        numbers = check_numbers("log_background", self.log_background, (3, 15))
        object.__setattr__(self, "log_background", (numbers[:15], numbers[15:30], numbers[30:]))
        object.__setattr__(self, "half_mm", check_positive("half_mm", self.half_mm))
        if not isinstance(self.source, str):
            raise TypeError(f"source: expected a text, got {brief(self.source)}")

    def background(self, height: int, width: int, mm_per_pixel: float) -> Tensor:
        """The smooth background of the unit it was fitted to, (3, H, W) float64, linear light."""
        x, y = pixel_grid_mm(height, width, mm_per_pixel, torch.float64)
        basis = position_basis(x.expand(height, width), y.expand(height, width), self.half_mm, 4)
        log_light: Tensor = torch.tensordot(torch.tensor(self.log_background, dtype=torch.float64), basis, 1)
        return log_light.exp()

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers."""
        rows = [[float(f"{number:.6g}") for number in row] for row in self.log_background]
        return {"source": self.source, "half_mm": self.half_mm, "log_background": rows, "response": self.response.to_dict()}

    @classmethod
    def from_dict(cls, values: Any, source: str) -> "SensorPrior":
        """Read the output of :meth:`to_dict`; ``source`` names it in errors."""
        if isinstance(values, dict) and "response" in values:
            values = values | {"response": ResponseModel.from_dict(values["response"], f"{source}: response")}
        return from_dict(cls, values, source)


def fit_log_background(background: Tensor, mm_per_pixel: float) -> tuple[tuple[float, ...], ...]:
    """``log_background`` of a :class:`SensorPrior`, by least squares.

    Args:
        background: (3, H, W), linear light.
        mm_per_pixel: pixel pitch, mm.
    """
    height, width = background.shape[1:]
    x, y = pixel_grid_mm(height, width, mm_per_pixel, torch.float64)
    basis = position_basis(x.expand(height, width), y.expand(height, width), 0.5 * width * mm_per_pixel, 4).flatten(1)
    values = background.double().clamp_min(1e-3).log().flatten(1)
    solution = torch.linalg.lstsq(basis.t(), values.t()).solution  # (15, 3)
    return tuple(tuple(float(v) for v in column) for column in solution.t())


def field_terms(uses_depth: bool, product_degree: int) -> list[tuple[int, ...]]:
    """Terms as indices of their inputs: all inputs, then products of two of changes and depth, except depth squared, which
    explains nothing."""
    single: list[tuple[int, ...]] = [(k,) for k in range(6 if uses_depth else 3)]
    pairs = [pair for pair in combinations_with_replacement(range(4 if uses_depth else 3), 2) if pair != (3, 3)]
    return single + (pairs if product_degree >= 0 else [])


def term_degrees_by_term(degree: int, product_degree: int, uses_depth: bool) -> dict[tuple[int, ...], int]:
    """Degree in position of every term, in order."""
    return {term: degree if len(term) == 1 else product_degree for term in field_terms(uses_depth, product_degree)}


def term_degrees(degree: int, product_degree: int, uses_depth: bool) -> list[int]:
    """Total degree in position of every coefficient, in order."""
    by_term = term_degrees_by_term(degree, product_degree, uses_depth)
    return [i + j for d in by_term.values() for i in range(d + 1) for j in range(d + 1 - i)]


def position_basis(x: Tensor, y: Tensor, half_mm: float, degree: int) -> Tensor:
    """Monomials of total degree up to ``degree`` in x / half_mm, y / half_mm: (n, *x.shape)."""
    u, v = x / half_mm, y / half_mm
    columns, rows = [torch.ones_like(u)], [torch.ones_like(v)]
    for _ in range(degree):
        columns.append(columns[-1] * u)
        rows.append(rows[-1] * v)
    return torch.stack([columns[i] * rows[j] for i in range(degree + 1) for j in range(degree + 1 - i)])


def term_values(
    change: Tensor, deep: Tensor | None, x: Tensor, y: Tensor, half_mm: float, degree: int, product_degree: int
) -> Tensor:
    """Factor of every coefficient at N places: (size, N).

    Args:
        change: (3, N), image / background - 1.
        deep: (3, N), depth in mm and its two slopes, for fields that use depth; else None.
        x: (N,), mm.
        y: (N,), mm.
        half_mm: scale of positions, mm.
        degree: of linear terms.
        product_degree: of products; -1 for none.
    """
    inputs = [*(change / CHANGE_SCALE), *([] if deep is None else deep)]
    bases = {d: position_basis(x, y, half_mm, d) for d in {degree, product_degree} if d >= 0}
    rows = []
    for term in field_terms(deep is not None, product_degree):
        value = math.prod([inputs[k] for k in term[1:]], start=inputs[term[0]])
        rows.append(value * bases[degree if len(term) == 1 else product_degree])
    return torch.cat(rows)
