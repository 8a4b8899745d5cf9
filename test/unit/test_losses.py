"""The direct terms of Eq. 7 and 8 against torch autograd."""

import numpy as np
import torch

from bdgs_ros.mapping import losses

RNG = np.random.default_rng(0)


def test_dynamic_penalty_matches_autograd() -> None:
    logit = RNG.normal(size=50).astype(np.float32)
    dynamic = RNG.random(50) < 0.5
    weight = RNG.random(50).astype(np.float32)
    loss, gradient = losses.dynamic_penalty(logit, dynamic, weight)
    x = torch.tensor(logit, dtype=torch.float64, requires_grad=True)
    expected = (torch.tensor(weight * dynamic) * torch.sigmoid(x) ** 2).sum()
    expected.backward()
    np.testing.assert_allclose(loss, expected.item(), rtol=1e-5)
    np.testing.assert_allclose(gradient, x.grad.numpy(), rtol=1e-4, atol=1e-6)
    assert not gradient[~dynamic].any()


def test_covariance_penalty_is_the_frobenius_norm_of_sigma() -> None:
    log_scales = RNG.normal(-2, 1, size=(20, 3)).astype(np.float32)
    loss, gradient = losses.covariance_penalty(log_scales)
    x = torch.tensor(log_scales, dtype=torch.float64, requires_grad=True)
    rotation = torch.linalg.qr(torch.randn(20, 3, 3, dtype=torch.float64)).Q
    sigma = rotation @ torch.diag_embed(torch.exp(2 * x)) @ rotation.mT
    expected = (sigma**2).sum()
    expected.backward()
    np.testing.assert_allclose(loss, expected.item(), rtol=1e-5)
    np.testing.assert_allclose(gradient, x.grad.numpy(), rtol=1e-4, atol=1e-7)
