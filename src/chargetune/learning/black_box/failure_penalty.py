"""A penalty on the acquisition near failed trials, which have no score."""

from __future__ import annotations

import torch
from botorch.acquisition.acquisition import AcquisitionFunction
from botorch.utils.transforms import t_batch_mode_transform

__all__ = ["AwayFromFailures"]

# Radius of the region around a failed trial in which failure is likely, as a share of the diagonal of the unit cube.
RADIUS = 0.05


class AwayFromFailures(AcquisitionFunction):
    """log a(x) + sum_j log(1 - exp(-|x - x_j|^2 / (2 r^2))) with failed trials x_j and r = 0.05 sqrt(d).

    The second term is the log probability of success at x if each failed trial x_j causes failure there with the probability
    exp(-|x - x_j|^2 / (2 r^2)), independently of the others.
    """

    def __init__(self, base: AcquisitionFunction, failed: torch.Tensor) -> None:
        super().__init__(model=base.model)
        self.base = base
        self.failed = failed

    @t_batch_mode_transform(assert_output_shape=False)  # type: ignore[arg-type] # it types self as the base class
    def forward(self, X: torch.Tensor) -> torch.Tensor:
        """X (b, q, d) -> (b,)."""
        value: torch.Tensor = self.base(X)
        if not len(self.failed):
            return value
        radius = RADIUS * X.shape[-1] ** 0.5
        distance = (X[..., None, :] - self.failed).square().sum(-1) / (2 * radius**2)
        success: torch.Tensor = torch.log(-torch.expm1(-distance - 1e-12)).sum(-1).amin(-1)
        return value + success
