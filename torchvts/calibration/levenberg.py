"""Levenberg-Marquardt as a torch optimiser for small least-squares problems."""

import inspect
from collections.abc import Callable

import torch
from torch import Tensor
from torch.optim import Optimizer


class LevenbergMarquardt(Optimizer):
    """Levenberg-Marquardt on groups of parameters that do not share residuals.

    Args:
        parameter: one tensor (G, K): K parameters of each of G independent problems.
        damping: start of the damping, relative to the diagonal of J^T J.
    Source:
        More, The Levenberg-Marquardt algorithm, LNM 630, 1978; damping by the gain as in Nielsen, IMM-REP-1999-05.
    Example:
        >>> x = torch.zeros(1, 1, requires_grad=True)
        >>> optimiser = LevenbergMarquardt(x)
        >>> for _ in range(20):
        ...     loss = optimiser.step(lambda values: values.exp() - 2.0, lambda values: (values.exp() - 2.0, values.exp()[:, None]))
        >>> round(x.item(), 5) == 0.69315
        True
    """

    add_param_group = inspect.unwrap(Optimizer.add_param_group)  # its wrapper imports torch._dynamo, which takes 2 s

    def __init__(self, parameter: Tensor, damping: float = 1e-3) -> None:
        super().__init__([parameter], {})
        self.damping = torch.full((parameter.shape[0],), damping, dtype=parameter.dtype, device=parameter.device)
        self.last_step = torch.full_like(parameter, torch.inf)

    @torch.no_grad()
    def step(  # type: ignore[override]
        self,
        closure: Callable[[Tensor], Tensor],
        linearised: Callable[[Tensor], tuple[Tensor, Tensor]],
        weight: Tensor | None = None,
    ) -> Tensor:
        """Take one step; a group whose loss would rise keeps its parameters and raises its damping.

        Args:
            closure: maps parameters (G, K) to residuals (G, N); group g depends only on row g.
            linearised: maps parameters to residuals and their derivatives (G, K, N).
            weight: (G, N), weights of the squared residuals; None for ones.
        Returns:
            (G,), half the weighted sum of squares before the step.
        """
        parameter = self.param_groups[0]["params"][0]
        residual, jacobian = linearised(parameter)
        weighted = jacobian if weight is None else jacobian * weight[:, None]
        normal_matrix = weighted @ jacobian.transpose(1, 2)
        right = -(weighted @ residual[:, :, None])[:, :, 0]
        diagonal = torch.diagonal(normal_matrix, dim1=1, dim2=2)
        floor = 1e-12 * diagonal.amax(1, keepdim=True).clamp_min(1e-300)
        damped = normal_matrix + torch.diag_embed(self.damping[:, None] * diagonal + floor)
        step = torch.linalg.solve_ex(damped, right[:, :, None])[0][:, :, 0]
        before, after = _half_square(residual, weight), _half_square(closure(parameter + step), weight)
        better = torch.isfinite(after) & (after <= before)
        parameter.copy_(torch.where(better[:, None], parameter + step, parameter))
        self.damping = torch.where(better, self.damping * 0.2, self.damping * 10.0).clamp(1e-12, 1e12)
        self.last_step = torch.where(better[:, None], step, self.last_step)
        return before


def _half_square(residual: Tensor, weight: Tensor | None) -> Tensor:
    squared = residual.square() if weight is None else residual.square() * weight
    return 0.5 * squared.sum(1)
