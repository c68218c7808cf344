"""ATCLoss against the published arithmetic, typed again with plain torch."""

from __future__ import annotations

import copy

import pytest
import torch
import torch.nn.functional as F
from loss_cases import as_images, atc, image_batch, passing_through, small_encoder
from tensor_checks import close, double
from tensordict import TensorDict

from crptpro.modules import AnchorHead, PixelEncoder, Projector
from crptpro.objectives import ATCLoss

pytestmark = pytest.mark.filterwarnings("ignore:No target network updater")


def released_update(loss: ATCLoss, td: TensorDict, invalid: list[int]):
    """rlpyt ``augmented_temporal_contrast.py`` and ``atc_models.py`` on copies of the parameters."""
    encoder, projector, head = (copy.deepcopy(m) for m in (loss.encoder, loss.projector, loss.anchor_head))
    target_encoder, target_projector = copy.deepcopy(encoder), copy.deepcopy(projector)
    target_encoder.load_state_dict(loss.target_state()["encoder"])
    target_projector.load_state_dict(loss.target_state()["projector"])
    anchor = projector(encoder(td["pixels"]))
    with torch.no_grad():
        positive = target_projector(target_encoder(td["next", "pixels"]))
    mlp = torch.nn.Sequential(head.hidden, torch.nn.ReLU(), head.output)
    anchor = anchor + mlp(anchor)
    logits = torch.matmul(head.bilinear(anchor), positive.T)
    logits = logits - torch.max(logits, dim=1, keepdim=True)[0]
    labels = torch.arange(len(logits))
    labels[invalid] = -100
    value = F.cross_entropy(logits, labels, ignore_index=-100)
    value.backward()
    return value.detach(), [p.grad for m in (encoder, projector, head) for p in m.parameters()]


@pytest.mark.parametrize("invalid", [[], [1, 4]])
def test_loss_and_gradients_equal_the_released_update(invalid: list[int]) -> None:
    loss, td = atc(), image_batch(12)
    with torch.no_grad():
        for parameter in loss.parameters():  # targets differ from their sources
            parameter.add_(0.05 * torch.randn_like(parameter))
    expected, gradients = released_update(loss, td, invalid)
    if invalid:
        mask = torch.ones(12, dtype=torch.bool)
        mask[invalid] = False
        td["collector", "mask"] = mask
    value = loss(td)["loss_contrast"]
    torch.testing.assert_close(value.detach(), expected)
    value.backward()
    for (name, parameter), gradient in zip(loss.named_parameters(), gradients, strict=True):
        torch.testing.assert_close(parameter.grad, gradient, rtol=1e-3, atol=1e-6, msg=name)


def test_golden_values_pass_through_the_module() -> None:
    encoder, projector = passing_through()
    head = AnchorHead(2, 4).double()
    with torch.no_grad():
        head.bilinear.weight.copy_(torch.eye(2))
        head.output.weight.zero_()
        head.output.bias.zero_()
    loss = ATCLoss(encoder, projector=projector, anchor_head=head, reduction="none")
    anchors, positives = double([[1, 2], [0, 1], [2, 0]]), double([[1, 1], [0, 2], [1, 0]])
    td = TensorDict({"pixels": as_images(anchors), "next": {"pixels": as_images(positives)}}, [3])
    close(loss(td)["loss_contrast"], double([1.349012, 0.407606, 0.758624]))
    loss.reduction = "mean"
    assert loss(td)["loss_contrast"].item() == pytest.approx(0.838414, abs=1e-6)


def test_a_positive_of_a_masked_row_stays_a_negative() -> None:
    td, mask = image_batch(6), torch.tensor([True] * 5 + [False])
    td["collector", "mask"] = mask
    masked, alone = atc()(td)["loss_contrast"], atc()(image_batch(6)[:5])["loss_contrast"]
    assert masked > alone


def test_the_gradient_reaches_the_anchors_side_only() -> None:
    loss, td = atc(), image_batch(6).apply(lambda pixels: pixels.float().requires_grad_())
    loss(td)["loss_contrast"].backward()
    assert td["pixels"].grad.any()
    assert td["next", "pixels"].grad is None


def test_default_heads_are_those_of_the_paper() -> None:
    loss = ATCLoss(PixelEncoder())
    sizes = [
        sum(p.numel() for p in getattr(loss, f"{name}_params").parameters()) for name in loss.network_names
    ]
    assert sizes == [30_368, 5_017_728, 148_096]
    weight = loss.projector.linear.weight
    assert weight.std().item() == pytest.approx((2 / 39_200) ** 0.5, rel=0.01)
    assert set(loss.target_state()) == {"encoder", "projector"}


def test_given_heads_are_trained_and_must_fit() -> None:
    encoder = small_encoder()
    projector, head = Projector(encoder.feature_dim, 6), AnchorHead(6, 8)
    loss = ATCLoss(encoder, projector=projector, anchor_head=head)
    assert (loss.encoder, loss.projector, loss.anchor_head) == (encoder, projector, head)
    assert (loss.latent_dim, loss.hidden_dim) == (6, 8)
    with pytest.raises(ValueError, match="projector 6, anchor_head 128"):
        ATCLoss(small_encoder(), projector=projector)
