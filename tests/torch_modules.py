"""Modules straight from PyTorch. Its name keeps it out of the default tests, which do without PyTorch.

Run by `python -m pytest tests/torch_modules.py`, with the extra `torch` installed.
"""

from __future__ import annotations

import numpy as np
import torch

from mn_onnx.extraction import extract
from mn_onnx.torch_modules import from_torch


def test_a_module_becomes_a_model() -> None:
    torch.manual_seed(0)
    module = torch.nn.Sequential(torch.nn.Linear(3, 16), torch.nn.ReLU(), torch.nn.Linear(16, 1))
    module.train()
    model = from_torch(module, bounds=(-1, 1))
    assert module.training
    assert model.exact
    points = np.random.default_rng(0).uniform(-1, 1, (64, 3)).astype(np.float32)
    expected = module(torch.from_numpy(points)).detach().numpy()[:, 0]
    np.testing.assert_allclose(model.evaluate(points), expected, atol=1e-5)
    assert extract(model, threads=1).report["unmatched_edges"] == 0


def test_further_inputs_are_bound() -> None:
    class Conditioned(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.layer = torch.nn.Linear(5, 1)

        def forward(self, x: torch.Tensor, code: torch.Tensor) -> torch.Tensor:
            return self.layer(torch.cat([x, code.expand(x.shape[0], 2)], dim=1))

    torch.manual_seed(0)
    module, code = Conditioned(), torch.tensor([[0.3, -0.2]])
    model = from_torch(module, inputs={"code": code})
    points = torch.zeros(4, 3)
    np.testing.assert_allclose(model.evaluate(points.numpy()), module(points, code).detach().numpy()[:, 0], atol=1e-6)
