"""Self-supervised losses against the published updates, typed again with plain torch; golden values."""

from __future__ import annotations

import copy
import math

import pytest
import torch
import torch.nn.functional as F
from loss_cases import (
    atc,
    becl,
    disturb,
    image_batch,
    proto,
    released_sinkhorn,
    simclr,
    skill_image_batch,
    small_encoder,
    target_state,
    view_batch,
)
from tensordict import TensorDict
from torch import Tensor, nn

from crptpro.modules import AnchorHead, PixelEncoder, Predictor, Projector, Prototypes, set_compute_dtype
from crptpro.objectives import ATCLoss, BeCLLoss, ProtoLoss, SimCLRLoss
from crptpro.objectives.functional import sinkhorn_knopp

pytestmark = pytest.mark.filterwarnings("ignore:No target network updater")


def copies(loss, *names: str) -> list[nn.Module]:
    """Networks with the same parameters; ``target_*`` with those of the target."""
    found = []
    for name in names:
        online = name.removeprefix("target_")
        found.append(copy.deepcopy(getattr(loss, online)))
        if name != online:
            found[-1].load_state_dict(target_state(loss, online))
    return found


def graded(value: Tensor, *modules: nn.Module) -> list:
    value.backward()
    return [p.grad for module in modules for p in module.parameters()]


def require_gradients(loss, gradients: list, tolerance: float = 1e-6) -> None:
    for (name, parameter), expected in zip(loss.named_parameters(), gradients, strict=True):
        torch.testing.assert_close(parameter.grad, expected, rtol=1e-3, atol=tolerance, msg=name)


def released_proto(loss: ProtoLoss, td: TensorDict, *, alpha: float, w: float, tau: float):
    """liuxin0824/CRPTpro proto.py ``update_proto``: both terms and the gradients."""
    encoder, projector, predictor = copies(loss, "encoder", "projector", "predictor")
    target_encoder, target_projector = copies(loss, "target_encoder", "target_projector")
    protos = nn.Linear(*reversed(loss.prototypes.weight.shape), bias=False)
    with torch.no_grad():
        protos.weight.copy_(F.normalize(loss.prototypes.weight, dim=1))

    z = F.normalize(predictor(projector(encoder(td["pixels"]))), dim=1)
    log_p = F.log_softmax(protos(z) / tau, dim=1)
    with torch.no_grad():
        target = F.normalize(target_projector(target_encoder(td["next", "pixels"])), dim=1)
        q = released_sinkhorn(protos(target), tau)
    comp = -(q * log_p).sum(dim=1).mean()

    similarity = protos.weight.detach() @ protos.weight.T
    ratio = similarity / (similarity.detach() + w)
    for i in range(ratio.shape[0]):
        ratio[i, i] = 0
    intr = ratio.mean()
    gradients = graded(comp + alpha * intr, encoder, projector, predictor, protos)
    return comp.detach(), intr.detach(), gradients


@pytest.mark.parametrize(("alpha", "w", "tau"), [(5e-3, 1.5, 0.1), (3.0, 2.0, 0.3)])
def test_proto_equals_the_released_update_in_value_and_gradients(alpha: float, w: float, tau: float) -> None:
    options = {} if tau == 0.1 else {"intr_loss_coef": alpha, "offset": w, "temperature": tau}
    loss, td = proto(**options), image_batch(12)
    disturb(loss)
    comp, intr, gradients = released_proto(loss.before_update(), td, alpha=alpha, w=w, tau=tau)
    out = loss(td)
    found = (out["loss_comp"].detach(), out["comp"], out["loss_intr"].detach(), out["intr"])
    torch.testing.assert_close(found, (comp, comp, alpha * intr, intr))
    (out["loss_comp"] + out["loss_intr"]).backward()
    require_gradients(loss, gradients)


def test_full_size_losses_have_the_published_parameters_and_proto_starts_near_its_published_value() -> None:
    def sizes(loss) -> list[int]:
        names = loss.network_names
        return [sum(p.numel() for p in getattr(loss, f"{name}_params").parameters()) for name in names]

    torch.manual_seed(0)
    loss, anchors, views = ProtoLoss(PixelEncoder()), ATCLoss(PixelEncoder()), SimCLRLoss(PixelEncoder())
    assert sizes(loss) == [30_368, 5_017_728, 263_296, 65_536]
    assert sizes(anchors) == [30_368, 5_017_728, 148_096]
    assert sizes(views) == [30_368, 5_017_728]
    assert anchors.projector.linear.weight.std().item() == pytest.approx((2 / 39_200) ** 0.5, rel=0.01)
    assert views.temperature.item() == 0.07
    pixels = torch.randint(0, 256, (16, 9, 84, 84), dtype=torch.uint8)
    with torch.no_grad():
        out = loss(TensorDict({"pixels": pixels, "next": {"pixels": pixels}}, [16]))
    # ln M = 6.238 would be an uninformed prediction; predictor and target are independent at first.
    assert 6.2 < out["loss_comp"] < 7.0
    torch.testing.assert_close(out["loss_intr"], 5e-3 * out["intr"])


def test_given_networks_are_trained_and_must_share_one_latent_length() -> None:
    encoder, predictor, prototypes = small_encoder(), Predictor(6, 8), Prototypes(10, 6)
    projector = Projector(encoder.feature_dim, 6)
    loss = ProtoLoss(encoder, projector=projector, predictor=predictor, prototypes=prototypes)
    given = (encoder, projector, predictor, prototypes)
    assert (loss.encoder, loss.projector, loss.predictor, loss.prototypes) == given
    assert {id(p) for p in loss.parameters()} == {id(p) for module in given for p in module.parameters()}
    with pytest.raises(ValueError, match=r"projector 6, predictor 6, prototypes 4; pass latent_dim="):
        proto(prototypes=Prototypes(10, 4))
    assert proto(projector=nn.Linear(encoder.feature_dim, 6))(image_batch())["loss_comp"].isfinite()
    with pytest.raises(ValueError, match="projector 6, anchor_head 128"):
        ATCLoss(small_encoder(), projector=projector)
    head = ATCLoss(encoder, projector=projector, anchor_head=AnchorHead(6, 8))
    assert (head.latent_dim, head.hidden_dim) == (6, 8)


def test_before_update_gives_unit_rows_and_forward_does_not_need_it() -> None:
    loss, td = proto(), image_batch()
    expected = loss(td)
    with torch.no_grad():
        loss.prototypes.weight.mul_(3.0)
    torch.testing.assert_close(loss(td)["loss_comp"], expected["loss_comp"])
    assert loss.before_update() is loss
    torch.testing.assert_close(loss.prototypes.weight.detach().norm(dim=1), torch.ones(10))


def test_coefficients_are_scheduled_in_place_and_the_assignments_follow_the_temperature_unless_given() -> None:
    td = image_batch()
    same, cold = proto(), proto(assignment_temperature=0.02)
    assert same.assignment_temperature is None
    torch.testing.assert_close(proto(assignment_temperature=0.1)(td)["comp"], same(td)["comp"])
    assert cold(td)["assignment_entropy"] < same(td)["assignment_entropy"]
    first = same(td)["loss_intr"]
    same.temperature, same.intr_loss_coef = 0.02, 0.5
    torch.testing.assert_close(same(td)["assignment_entropy"], cold(td)["assignment_entropy"])
    torch.testing.assert_close(same(td)["loss_intr"], 100 * first)
    assert same.state_dict()["intr_loss_coef"].item() == 0.5


def test_diagnostics_describe_the_batch_and_identical_images_read_as_a_dead_run() -> None:
    loss, td = proto(), image_batch(8)
    out = loss(td)
    with torch.no_grad():
        z = F.normalize(loss.projector(loss.encoder(td["pixels"])), dim=1)
        following = F.normalize(loss.projector(loss.encoder(td["next", "pixels"])), dim=1)
        q = sinkhorn_knopp(following @ F.normalize(loss.prototypes.weight, dim=1).T)
    cosines = (z @ z.T)[~torch.eye(8, dtype=torch.bool)]
    assert out["embedding_cosine"].item() == pytest.approx(cosines.mean().item(), abs=1e-5)
    assert out["prototypes_in_use"].item() == q.argmax(dim=1).unique().numel()
    entropy = -(q * q.log()).sum(dim=1).mean().item()
    assert out["assignment_entropy"].item() == pytest.approx(entropy, abs=1e-4)
    dead = proto()(image_batch(1).expand(8).contiguous())
    assert dead["embedding_cosine"].item() == pytest.approx(1.0, abs=1e-5)
    assert dead["assignment_entropy"].item() == pytest.approx(math.log(10), abs=1e-5)
    assert dead["comp"].item() >= math.log(10) - 1e-5


def test_bfloat16_is_close_to_float32_and_softmax_and_sinkhorn_stay_in_float32_under_autocast_too() -> None:
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
    with torch.autocast("cpu", dtype=torch.bfloat16):
        out = proto()(td)
    assert out["loss_comp"].dtype == torch.float32
    assert out["loss_comp"].item() == pytest.approx(reference, rel=0.05)


@pytest.mark.parametrize(
    ("make", "options", "message"),
    [
        (proto, {"offset": 1.0}, "`offset` must exceed 1"),
        (proto, {"assignment_temperature": -1.0}, "`assignment_temperature` must be positive"),
        (proto, {"sinkhorn_iterations": 2.5}, "`sinkhorn_iterations` must be a whole number"),
        (simclr, {"temperature": 0}, "`temperature` must be positive, got 0"),
        (becl, {"temperature": -1}, "`temperature` must be positive, got -1"),
    ],
)
def test_impossible_options_are_refused_by_name(make, options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make(**options)


def test_skills_that_are_integers_are_refused() -> None:
    td = skill_image_batch()
    for skills in (td["skill"].argmax(-1), td["skill"].argmax(-1, keepdim=True)):
        with pytest.raises(ValueError, match=r"Skills must be one-hot, \[6, K\] .*, got"):
            becl()(td.copy().set("skill", skills))


def released_atc(loss: ATCLoss, td: TensorDict):
    """rlpyt ``augmented_temporal_contrast.py`` and ``atc_models.py``."""
    encoder, projector, head = copies(loss, "encoder", "projector", "anchor_head")
    target_encoder, target_projector = copies(loss, "target_encoder", "target_projector")
    anchor = projector(encoder(td["pixels"]))
    with torch.no_grad():
        positive = target_projector(target_encoder(td["next", "pixels"]))
    mlp = nn.Sequential(head.hidden, nn.ReLU(), head.output)
    anchor = anchor + mlp(anchor)
    logits = torch.matmul(head.bilinear(anchor), positive.T)
    logits = logits - torch.max(logits, dim=1, keepdim=True)[0]
    value = F.cross_entropy(logits, torch.arange(len(logits)))
    return value.detach(), graded(value, encoder, projector, head)


def released_simclr(loss: SimCLRLoss, td: TensorDict):
    """The authors' InfoNCE over 2B views: the positive is moved to column 0 of the logits."""
    encoder, projector = copies(loss, "encoder", "projector")
    features = F.normalize(projector(encoder(torch.cat([td["pixels"], td["pixels_view"]]))), dim=1)
    labels = torch.cat([torch.arange(len(td)), torch.arange(len(td))])
    labels = (labels[:, None] == labels[None]).float()
    similarity = features @ features.T
    others = ~torch.eye(len(labels), dtype=torch.bool)
    labels = labels[others].view(len(labels), -1)
    similarity = similarity[others].view(len(labels), -1)
    positives = similarity[labels.bool()].view(len(labels), -1)
    negatives = similarity[~labels.bool()].view(len(labels), -1)
    logits = torch.cat([positives, negatives], dim=1) / 0.07
    value = F.cross_entropy(logits, torch.zeros(len(logits), dtype=torch.long))
    return value.detach(), graded(value, encoder, projector)


def released_becl(loss: BeCLLoss, td: TensorDict):
    """Rooshy-yang/BeCL ``agent/becl.py``."""
    encoder, head = copies(loss, "encoder", "projector")
    embed = nn.Sequential(head.embed_input, nn.ReLU(), head.embed_hidden, nn.ReLU(), head.embed_output)
    project = nn.Sequential(head.project_hidden, nn.ReLU(), head.project_output)
    features = F.normalize(project(embed(encoder(td["next", "pixels"]))), dim=1)
    skills = td["skill"].argmax(dim=1)
    count = len(skills)
    off = ~torch.eye(count, dtype=torch.bool)
    same = (skills[:, None] == skills[None]).long()[off].view(count, -1)
    similarity = (features @ features.T / 0.5)[off].view(count, -1)
    similarity = similarity - similarity.max(dim=1, keepdim=True)[0].detach()
    similarity = similarity.exp()
    positive = similarity.gather(1, same.argmax(dim=1, keepdim=True)).squeeze(1)
    value = -torch.log(positive / (similarity.sum(dim=1) + 1e-6) + 1e-6).mean()
    return value.detach(), graded(value, encoder, head)


@pytest.mark.parametrize(
    ("make", "batch", "released"),
    [(atc, image_batch, released_atc), (simclr, view_batch, released_simclr), (becl, skill_image_batch, released_becl)],
)
def test_contrastive_losses_and_gradients_equal_the_released_updates(make, batch, released) -> None:
    loss, td = make(), batch(5)
    disturb(loss)
    expected, gradients = released(loss, td)
    value = loss(td)["loss_contrast"]
    torch.testing.assert_close(value.detach(), expected)
    value.backward()
    require_gradients(loss, gradients, 1e-5)


def test_a_loss_says_which_entries_are_second_views() -> None:
    assert proto().views == {}
    views = simclr()
    assert views.views == {"pixels_view": "pixels"}
    views.set_keys(observation=("next", "pixels"), observation_view=("next", "pixels_view"))
    assert views.views == {("next", "pixels_view"): ("next", "pixels")}
