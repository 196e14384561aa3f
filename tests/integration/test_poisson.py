"""Poisson integration against dense least squares, and what mathematics promises of it."""

import math
from itertools import pairwise

import numpy as np
import pytest
import references
import torch

import torchvts as vts
from lab import metrics
from torchvts.integration import PerspectiveIntegration

SIZES = [(3, 3), (4, 4), (5, 8), (8, 5), (7, 11), (13, 13), (12, 10), (3, 16), (15, 14), (9, 6)]
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
    scene = vts.scenes.surface(vts.scenes.sine_depth(), height=120, width=160, mm_per_pixel=0.25, dtype=torch.float64)
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


def test_sphere_error_is_the_integrators_floor_of_the_paper():
    """The kink at the rim is all that is left when gradients are exact (figure 3 of the paper: 0.09 and 0.16 px)."""
    for press, bound in ((1.0, 0.110), (2.0, 0.158)):
        scene = vts.scenes.sphere_press(10.0, press)
        for solver in (vts.poisson_dst, vts.poisson_background):
            assert metrics.depth_error(solver(scene.gradient, 0.0625), scene.depth_mm, 0.0625).max_px < bound
