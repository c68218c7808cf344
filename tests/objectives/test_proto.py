"""ProtoLoss against the published update, typed again with plain torch."""

from __future__ import annotations

import copy
import math

import pytest
import torch
import torch.nn.functional as F
from loss_cases import image_batch, proto, small_encoder
from tensordict import TensorDict
from torchrl.objectives import SoftUpdate

from crptpro.modules import PixelEncoder, Predictor, Projector, Prototypes, set_compute_dtype
from crptpro.objectives import ProtoLoss
from crptpro.objectives.functional import sinkhorn_knopp

pytestmark = pytest.mark.filterwarnings("ignore:No target network updater")


def released_update(loss: ProtoLoss, td: TensorDict, targets: dict, *, alpha: float, w: float, tau: float):
    """liuxin0824/CRPTpro proto.py ``update_proto``, on copies of the same parameters; returns terms and gradients."""
    encoder, projector, predictor = (copy.deepcopy(m) for m in (loss.encoder, loss.projector, loss.predictor))
    target_encoder, target_projector = copy.deepcopy(encoder), copy.deepcopy(projector)
    target_encoder.load_state_dict(targets["encoder"])
    target_projector.load_state_dict(targets["projector"])
    protos = torch.nn.Linear(*reversed(loss.prototypes.weight.shape), bias=False)
    with torch.no_grad():
        protos.weight.copy_(F.normalize(loss.prototypes.weight, dim=1))

    z = F.normalize(predictor(projector(encoder(td["pixels"]))), dim=1)
    log_p = F.log_softmax(protos(z) / tau, dim=1)
    with torch.no_grad():
        target = F.normalize(target_projector(target_encoder(td["next", "pixels"])), dim=1)
        scores = protos(target) / tau
        q = torch.exp(scores - scores.max()).T
        q /= q.sum()
        for _ in range(3):
            q *= (1 / q.shape[0] / q.sum(dim=1)).unsqueeze(1)
            q *= (1 / q.shape[1] / q.sum(dim=0)).unsqueeze(0)
        q = (q / q.sum(dim=0, keepdim=True)).T
    comp = -(q * log_p).sum(dim=1).mean()

    similarity = protos.weight.detach() @ protos.weight.T
    ratio = similarity / (similarity.detach() + w)
    for i in range(ratio.shape[0]):
        ratio[i, i] = 0
    intr = ratio.mean()
    (comp + alpha * intr).backward()
    modules = (encoder, projector, predictor, protos)
    return comp.detach(), intr.detach(), [p.grad for module in modules for p in module.parameters()]


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"intr_loss_coef": 3.0, "offset": 2.0, "temperature": 0.3},
    ],
)
def test_total_loss_and_gradients_equal_the_released_update(options: dict) -> None:
    loss, td = proto(**options), image_batch(12)
    with torch.no_grad():
        for parameter in loss.parameters():  # targets differ from their sources, prototypes are not unit
            parameter.add_(0.05 * torch.randn_like(parameter))
    settings = {"intr_loss_coef": 5e-3, "offset": 1.5, "temperature": 0.1, **options}
    comp, intr, gradients = released_update(
        loss.before_update(),
        td,
        loss.target_state(),
        alpha=settings["intr_loss_coef"],
        w=settings["offset"],
        tau=settings["temperature"],
    )
    out = loss(td)
    torch.testing.assert_close(out["loss_comp"].detach(), comp)
    torch.testing.assert_close(out["loss_intr"].detach(), settings["intr_loss_coef"] * intr)
    torch.testing.assert_close(out["comp"], comp)
    torch.testing.assert_close(out["intr"], intr)
    (out["loss_comp"] + out["loss_intr"]).backward()
    for (name, parameter), expected in zip(loss.named_parameters(), gradients, strict=True):
        torch.testing.assert_close(parameter.grad, expected, rtol=1e-3, atol=1e-6, msg=name)


def test_full_size_loss_has_the_published_parameters_and_starts_near_its_published_value() -> None:
    torch.manual_seed(0)
    loss = ProtoLoss(PixelEncoder())
    sizes = [
        sum(p.numel() for p in getattr(loss, f"{name}_params").parameters()) for name in loss.network_names
    ]
    assert sizes == [30_368, 5_017_728, 263_296, 65_536]
    pixels = torch.randint(0, 256, (16, 9, 84, 84), dtype=torch.uint8)
    with torch.no_grad():
        out = loss(TensorDict({"pixels": pixels, "next": {"pixels": pixels}}, [16]))
    # ln M = 6.238 would be an uninformed prediction; predictor and target are independent at first.
    assert 6.2 < out["loss_comp"] < 7.0
    assert -28.5e-4 < out["intr"] < -22.5e-4
    torch.testing.assert_close(out["loss_intr"], 5e-3 * out["intr"])


def test_trained_networks_are_the_ones_that_were_given() -> None:
    encoder, projector, predictor = small_encoder(), Projector(64, 6), Predictor(6, 8)
    prototypes = Prototypes(10, 6)
    projector = Projector(encoder.feature_dim, 6)
    loss = ProtoLoss(encoder, projector=projector, predictor=predictor, prototypes=prototypes)
    assert (loss.encoder, loss.projector, loss.predictor, loss.prototypes) == (
        encoder,
        projector,
        predictor,
        prototypes,
    )
    before = encoder.convs[0].weight.clone()
    optimizer = torch.optim.SGD(loss.parameters(), lr=1.0)
    loss(image_batch())["loss_comp"].backward()
    optimizer.step()
    assert not torch.equal(encoder.convs[0].weight, before)


def test_targets_start_as_copies_and_feed_only_the_assignments() -> None:
    loss, td = proto(), image_batch()
    for name, module in (("encoder", loss.encoder), ("projector", loss.projector)):
        state = loss.target_state()[name]
        assert state.keys() == module.state_dict().keys()
        assert all(torch.equal(state[key], value) for key, value in module.state_dict().items())
    assert set(loss.target_state()) == {"encoder", "projector"}
    before = loss(td)
    for value in loss.target_state()["encoder"].values():
        value.mul_(-1.0)  # live tensors: the target changes
    after = loss(td)
    assert not torch.equal(after["loss_comp"], before["loss_comp"])
    assert torch.equal(after["embedding_cosine"], before["embedding_cosine"])


def test_before_update_gives_unit_rows_and_forward_does_not_need_it() -> None:
    loss, td = proto(), image_batch()
    expected = loss(td)
    with torch.no_grad():
        loss.prototypes.weight.mul_(3.0)
    torch.testing.assert_close(loss(td)["loss_comp"], expected["loss_comp"])
    assert loss.before_update() is loss
    torch.testing.assert_close(loss.prototypes.weight.detach().norm(dim=1), torch.ones(10))


def test_through_norm_removes_the_radial_gradient() -> None:
    for through_norm in (False, True):
        loss = proto(through_norm=through_norm)
        out = loss(image_batch())
        (out["loss_comp"] + out["loss_intr"]).backward()
        weight = loss.prototypes.weight
        radial = (weight.grad * weight.detach()).sum(dim=1)
        assert (radial.abs().max() < 1e-6) == through_norm


def test_assignment_temperature_follows_the_temperature_unless_given() -> None:
    td = image_batch()
    same, cold = proto(), proto(assignment_temperature=0.02)
    assert same.assignment_temperature is None
    torch.testing.assert_close(proto(assignment_temperature=0.1)(td)["comp"], same(td)["comp"])
    assert cold(td)["assignment_entropy"] < same(td)["assignment_entropy"]
    same.temperature = 0.02  # scheduled in place
    torch.testing.assert_close(same(td)["assignment_entropy"], cold(td)["assignment_entropy"])


def test_scheduled_coefficients_act_on_the_next_call() -> None:
    loss, td = proto(), image_batch()
    first = loss(td)["loss_intr"]
    loss.intr_loss_coef = 0.5
    torch.testing.assert_close(loss(td)["loss_intr"], 100 * first)
    assert loss.state_dict()["intr_loss_coef"].item() == 0.5


@pytest.mark.parametrize(("reduction", "factor"), [("sum", 100), ("mean_offdiag", 100 / 90)])
def test_dispersion_reduction_is_an_option(reduction: str, factor: float) -> None:
    td = image_batch()
    torch.testing.assert_close(proto(intr_reduction=reduction)(td)["intr"], factor * proto()(td)["intr"])


def test_diagnostics_describe_the_batch() -> None:
    loss, td = proto(), image_batch(8)
    out = loss(td)
    with torch.no_grad():
        z = F.normalize(loss.projector(loss.encoder(td["pixels"])), dim=1)
        following = F.normalize(loss.projector(loss.encoder(td["next", "pixels"])), dim=1)
        q = sinkhorn_knopp(following @ F.normalize(loss.prototypes.weight, dim=1).T)
    cosines = (z @ z.T)[~torch.eye(8, dtype=torch.bool)]
    assert out["embedding_cosine"].item() == pytest.approx(cosines.mean().item(), abs=1e-5)
    assert out["prototypes_in_use"].item() == q.argmax(dim=1).unique().numel()
    assert out["assignment_entropy"].item() == pytest.approx(
        -(q * q.log()).sum(dim=1).mean().item(), abs=1e-4
    )


def test_identical_images_read_as_a_dead_run() -> None:
    td = image_batch(1).expand(8).contiguous()
    out = proto()(td)
    assert out["embedding_cosine"].item() == pytest.approx(1.0, abs=1e-5)
    assert out["assignment_entropy"].item() == pytest.approx(math.log(10), abs=1e-5)
    assert out["comp"].item() >= math.log(10) - 1e-5


def test_bfloat16_loss_and_gradients_are_close_to_float32() -> None:
    td = image_batch(16)
    results = []
    for dtype in (torch.float32, torch.bfloat16):
        loss = set_compute_dtype(proto(), dtype)
        out = loss(td)
        assert all(value.dtype == torch.float32 for value in out.values())
        out["loss_comp"].backward()
        gradient = torch.cat([p.grad.flatten() for p in loss.parameters()])
        results.append((out["loss_comp"].item(), gradient))
    (reference, expected), (low, gradient) = results
    assert low == pytest.approx(reference, rel=0.01)
    assert F.cosine_similarity(gradient, expected, dim=0) > 0.99


def test_autocast_around_the_loss_leaves_softmax_and_sinkhorn_in_float32() -> None:
    loss, td = proto(), image_batch(16)
    expected = loss(td)["loss_comp"].item()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        out = loss(td)
    assert out["loss_comp"].dtype == torch.float32
    assert out["loss_comp"].item() == pytest.approx(expected, rel=0.05)


def test_soft_update_covers_encoder_and_projector_only() -> None:
    loss = proto()
    updater = SoftUpdate(loss, tau=0.05)
    before = {key: value.clone() for key, value in loss.target_state()["encoder"].items()}
    with torch.no_grad():
        for parameter in loss.encoder.parameters():
            parameter.add_(1.0)
    updater.step()
    for key, value in loss.target_state()["encoder"].items():
        torch.testing.assert_close(value, before[key] + 0.05)
    targets = {name.split(".")[0] for name in loss.state_dict() if name.startswith("target_")}
    assert targets == {"target_encoder_params", "target_projector_params"}


def test_a_missing_entry_is_named() -> None:
    with pytest.raises(KeyError, match=r"\('next', 'pixels'\)"):
        proto()(TensorDict({"pixels": image_batch()["pixels"]}, [6]))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"offset": 1.0}, "offset must exceed 1"),
        ({"temperature": 0.0}, "temperature must be positive"),
        ({"assignment_temperature": -1.0}, "assignment_temperature must be positive"),
        ({"sinkhorn_iterations": -1}, "sinkhorn_iterations"),
        ({"intr_reduction": "mean"}, "intr_reduction must be"),
    ],
)
def test_impossible_options_are_refused(options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        proto(**options)


def test_heads_of_different_latent_lengths_are_refused_naming_each() -> None:
    with pytest.raises(ValueError, match=r"projector 6, predictor 6, prototypes 4; pass latent_dim="):
        proto(prototypes=Prototypes(10, 4))
    wide = Projector(small_encoder().feature_dim, 9)
    with pytest.raises(ValueError, match="projector 9, predictor 6, prototypes 6"):
        proto(projector=wide)
    mute = torch.nn.Linear(small_encoder().feature_dim, 6)
    assert proto(projector=mute)(image_batch())["loss_comp"].isfinite()
