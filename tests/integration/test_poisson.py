"""Poisson integration against dense least squares, and what mathematics promises of it."""

import math
from itertools import pairwise

import numpy as np
import pytest
import references
import torch

import torchvts as vts
from lab import metrics
from torchvts.integration import PerspectiveIntegration, divergence
from torchvts.integration.poisson import plan_dct
from torchvts.integration.screened import solve_screened

SIZES = [(3, 3), (4, 4), (5, 8), (8, 5), (7, 11), (13, 13), (12, 10), (3, 16), (15, 14), (9, 6)]
both_ways = pytest.mark.parametrize("size", [(11, 13), (9, 14)], ids=["prime and odd", "small factors"])
SOLVERS = {"zero": (vts.poisson_dst, references.poisson_zero), "free": (vts.poisson_dct, references.poisson_free)}


def random_gradient(height, width, batch=1, dtype=torch.float64, seed=0):
    return torch.randn(batch, 2, height, width, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(dtype)


@pytest.mark.parametrize("border", SOLVERS)
@pytest.mark.parametrize("size", SIZES)
def test_equals_dense_least_squares(border, size):
    solver, twin = SOLVERS[border]
    gradient = random_gradient(*size, seed=size[0])
    depth = solver(gradient, 0.37)
    assert np.abs(depth[0, 0].numpy() - twin(gradient[0].numpy(), 0.37)).max() < 1e-12


@pytest.mark.parametrize("size", [(2, 2), (2, 7), (5, 2)])
def test_a_free_border_needs_two_pixels_only(size):
    gradient = random_gradient(*size)
    depth = vts.poisson_dct(gradient, 0.5)
    assert np.abs(depth[0, 0].numpy() - references.poisson_free(gradient[0].numpy(), 0.5)).max() < 1e-13


@pytest.mark.parametrize("size", [(6, 5), (5, 6)])
@pytest.mark.parametrize("solver", [vts.poisson_dst, vts.poisson_dct, vts.poisson_background])
def test_derivatives(solver, size):
    assert torch.autograd.gradcheck(lambda gradient: solver(gradient, 0.3), random_gradient(*size).requires_grad_(True))


@pytest.mark.parametrize("solver", [vts.poisson_dst, vts.poisson_dct])
@both_ways
def test_the_solve_is_its_own_adjoint(size, solver):
    one, two = random_gradient(*size, seed=1), random_gradient(*size, seed=2)
    forward, backward = (solver(one) * divergence(two)).sum(), (solver(two) * divergence(one)).sum()
    assert float(forward) == pytest.approx(float(backward), rel=1e-12)


@pytest.mark.parametrize("solver, border", [(vts.poisson_dst, 1), (vts.poisson_dct, 0)])
@both_ways
def test_the_five_point_laplacian_of_depth_is_the_divergence(size, solver, border):
    gradient = random_gradient(*size)
    padded = torch.nn.functional.pad(solver(gradient), [1, 1, 1, 1], mode="replicate")
    around = padded[..., 1:-1, 2:] + padded[..., 1:-1, :-2] + padded[..., 2:, 1:-1] + padded[..., :-2, 1:-1]
    error = around - 4 * padded[..., 1:-1, 1:-1] - divergence(gradient)
    assert error[..., border : size[0] - border, border : size[1] - border].abs().max() < 1e-13


def dome(x, y):
    """Zero on the border of [-1, 1]^2, and no eigenfunction."""
    return (1 - x**2) * (1 - y**2) * torch.exp(0.5 * x - 0.3 * y)


def saddle(x, y):
    """Nothing vanishes on the border."""
    return torch.exp(0.6 * x) * torch.sin(1.7 * y + 0.4) + 0.3 * x**3


@pytest.mark.parametrize("sizes", [(17, 33, 65, 129), (16, 32, 64, 128)], ids=["odd", "even"])
@pytest.mark.parametrize("solver, shape", [(vts.poisson_dst, dome), (vts.poisson_dct, saddle), (vts.poisson_dct, dome)])
def test_order_of_convergence_is_two(solver, shape, sizes):
    errors = []
    for n in sizes:
        axis = torch.linspace(-1, 1, n, dtype=torch.float64)
        x, y = axis.expand(n, n).clone().requires_grad_(), axis[:, None].expand(n, n).clone().requires_grad_()
        z = shape(x, y)
        gradient = torch.stack(torch.autograd.grad(z.sum(), (x, y)))[None]
        error = solver(gradient, 2.0 / (n - 1))[0, 0] - z.detach()
        errors.append(float((error - (error.mean() if solver is vts.poisson_dct else 0)).square().mean().sqrt()))
    for (coarse, fine), (few, many) in zip(pairwise(errors), pairwise(sizes)):
        assert math.log(coarse / fine) / math.log((many - 1) / (few - 1)) == pytest.approx(2.0, abs=0.15)


def test_rest_equals_the_zero_border_for_a_contact_inside():
    scene = vts.scenes.sine_press(height=120, width=160, mm_per_pixel=0.25, dtype=torch.float64)
    rest, zero = vts.poisson_background(scene.gradient, 0.25), vts.poisson_dst(scene.gradient, 0.25)
    assert (rest - zero).abs().max() < 1e-4 * scene.depth_mm.max()
    assert rest[~scene.contact].mean().abs() < 1e-14


@pytest.mark.parametrize("center", [(20.0, 0.0), (0.0, -15.0), (20.0, 15.0)])
def test_rest_stays_right_where_the_border_cuts_the_contact(center):
    scene = vts.scenes.sphere_press(10.0, 1.0, center, 240, 320, 0.125, torch.float64)
    error = {
        solver: metrics.depth_error(solver(scene.gradient, 0.125), scene.depth_mm, 0.125).max_px
        for solver in (vts.poisson_background, vts.poisson_dst)
    }
    assert error[vts.poisson_background] < 0.2
    assert error[vts.poisson_dst] > 20 * error[vts.poisson_background]


def test_a_frame_without_an_undeformed_pixel_has_zero_as_its_lowest_depth():
    depth = vts.poisson_background(torch.full((1, 2, 8, 9), 0.1, dtype=torch.float64), 0.5)
    assert depth.min() == 0
    assert float(depth.max()) == pytest.approx(0.1 * 0.5 * (7 + 8), abs=1e-13)


@pytest.mark.parametrize("solver", [vts.poisson_dst, vts.poisson_dct])
def test_autocast_takes_no_digits(solver):
    gradient = random_gradient(9, 12).float()
    with torch.autocast("cpu", torch.bfloat16):
        lowered = solver(gradient)
    assert lowered.dtype == torch.float32 and torch.equal(lowered, solver(gradient))


@pytest.mark.parametrize("module", [vts.PoissonDST, vts.PoissonDCT, vts.PoissonBackground])
def test_a_module_equals_its_function_whatever_size_it_saw_before(module):
    function = {vts.PoissonDST: vts.poisson_dst, vts.PoissonDCT: vts.poisson_dct, vts.PoissonBackground: vts.poisson_background}[
        module
    ]
    block = module(0.3)
    for size, dtype in [((9, 12), torch.float64), ((12, 9), torch.float64), ((9, 12), torch.float32), ((3, 3), torch.float32)]:
        gradient = random_gradient(*size, dtype=dtype)
        assert float((block(gradient) - function(gradient, 0.3)).abs().max()) < 1e-6  # compiled kernels round differently


FUNCTIONS = (vts.poisson_dst, vts.poisson_dct, vts.poisson_background)
MODULES = (vts.PoissonDCT(0.3), vts.PoissonBackground(0.3), vts.AdaptiveIntegration(0.3), PerspectiveIntegration(0.3, 30.0))


@pytest.mark.parametrize("solver", [*FUNCTIONS, *MODULES], ids=lambda solver: getattr(solver, "__name__", type(solver).__name__))
def test_a_batch_of_none_is_integrated(solver):
    gradient = torch.zeros(0, 2, 9, 12, requires_grad=True)
    assert solver(gradient).shape == (0, 1, 9, 12)


def tilted(height=24, width=31, pitch=0.2):
    """A surface whose edges have exactly the mean slope of their pixels, and its slopes."""
    y, x = torch.meshgrid(torch.arange(height, dtype=torch.float64), torch.arange(width, dtype=torch.float64), indexing="ij")
    x, y = pitch * x, pitch * y
    depth = 0.7 + 0.02 * (x - 2) ** 2 - 0.015 * (y - 1) ** 2 + 0.01 * x * y
    return depth[None, None], torch.stack((0.04 * (x - 2) + 0.01 * y, 0.01 * x - 0.03 * (y - 1)))[None]


def known_at(*places, weight=1.0):
    found = torch.zeros(1, 1, 24, 31, dtype=torch.float64)
    for row, column in places:
        found[0, 0, row, column] = weight
    return found


KNOWN_AT = {
    "all alike": torch.full((1, 1, 1, 1), 2.0, dtype=torch.float64),
    "a pixel": known_at((3, 4)),
    "two fixed pixels": known_at((3, 4), (20, 9), weight=1e6),
    "a fixed half": (torch.arange(31) < 15).double().expand(1, 1, 24, 31) * 1e6,
}


@pytest.mark.parametrize("case", KNOWN_AT)
@pytest.mark.parametrize("kind", [vts.PoissonDCT, vts.PoissonBackground])
def test_known_depth_that_agrees_gives_the_height_and_changes_no_slope(kind, case):
    depth, gradient = tilted()
    found = kind(0.2)(gradient, depth * (KNOWN_AT[case] > 0), KNOWN_AT[case])
    assert float((found - depth).abs().max()) < 1e-6
    scripted = torch.jit.script(kind(0.2))(gradient, depth * (KNOWN_AT[case] > 0), KNOWN_AT[case])
    assert torch.equal(scripted, found)


def test_known_depth_and_slopes_that_disagree_are_weighed_by_least_squares():
    pitch, random = 0.3, torch.Generator().manual_seed(5)
    gradient, known = random_gradient(6, 7), torch.randn(1, 1, 6, 7, generator=random, dtype=torch.float64)
    for weight in (torch.rand(1, 1, 6, 7, generator=random, dtype=torch.float64), torch.full((1, 1, 1, 1), 3.0).double()):
        found = vts.PoissonDCT(pitch)(gradient, known, weight).requires_grad_(True)
        energy = (weight * (found - known).square()).sum()
        for axis, dim in ((0, 3), (1, 2)):
            slope = gradient[:, axis : axis + 1]
            mean = 0.5 * (slope.narrow(dim, 1, slope.shape[dim] - 1) + slope.narrow(dim, 0, slope.shape[dim] - 1))
            energy = energy + (found.diff(dim=dim) / pitch - mean).square().sum()
        (steepest,) = torch.autograd.grad(energy, found)
        assert float(steepest.abs().max()) < 1e-7  # of the minimum


@pytest.mark.parametrize("weight", [torch.rand(2, 1, 5, 6).double(), torch.rand(2, 1, 1, 1).double()], ids=["map", "uniform"])
@pytest.mark.parametrize("block", [vts.PoissonDCT(0.5), PerspectiveIntegration(0.5, 30.0)], ids=["flat", "perspective"])
def test_known_depth_has_derivatives(block, weight):
    given = (0.1 * random_gradient(5, 6, batch=2), torch.rand(2, 1, 5, 6).double(), weight.clone())
    assert torch.autograd.gradcheck(block, tuple(value.requires_grad_(True) for value in given))


def test_known_depth_that_does_not_settle_is_told():
    depth, gradient = tilted()
    right, pull = 0.2 * divergence(gradient), 0.04 * KNOWN_AT["a fixed half"]
    with pytest.warns(UserWarning, match="known_weight: the depth of 1 of 1 frames has not settled in 3 steps"):
        solve_screened(right, pull, depth, plan_dct(gradient, 24, 31), 1e-10, max_iterations=3)


def test_known_depth_seen_by_a_pinhole_keeps_its_height():
    block = PerspectiveIntegration(0.2, 30.0)
    flat, known = torch.zeros(1, 2, 24, 31, dtype=torch.float64), torch.full((1, 1, 24, 31), 1.5, dtype=torch.float64)
    for weight in KNOWN_AT.values():
        assert torch.jit.script(block)(flat, known, weight) == pytest.approx(1.5, abs=1e-6)
    with pytest.raises(
        ValueError, match="known_mm: expected none, got one: only PoissonDCT and PoissonBackground take known depth"
    ):
        PerspectiveIntegration(0.2, 30.0, vts.PoissonDST(0.2))(flat, known, KNOWN_AT["a pixel"])


def test_sphere_error_is_the_integrators_floor_of_the_paper():
    """The kink at the rim is all that is left when gradients are exact (figure 3 of the paper: 0.09 and 0.16 px)."""
    for press, bound in ((1.0, 0.110), (2.0, 0.158)):
        scene = vts.scenes.sphere_press(10.0, press)
        for solver in (vts.poisson_dst, vts.poisson_background):
            assert metrics.depth_error(solver(scene.gradient, 0.0625), scene.depth_mm, 0.0625).max_px < bound
