"""Self-supervised losses against the published updates, typed again with plain torch; golden values."""

from __future__ import annotations

import copy
import math

import pytest
import torch
import torch.nn.functional as F
from loss_cases import (
    SKILLS,
    atc,
    becl,
    image_batch,
    proto,
    simclr,
    skill_image_batch,
    small_encoder,
    target_state,
    view_batch,
)
from tensordict import TensorDict

from crptpro.modules import AnchorHead, PixelEncoder, Predictor, Projector, Prototypes, set_compute_dtype
from crptpro.objectives import ATCLoss, BeCLLoss, ProtoLoss, SimCLRLoss
from crptpro.objectives.functional import sinkhorn_knopp

pytestmark = pytest.mark.filterwarnings("ignore:No target network updater")


def disturb(loss) -> None:
    """Targets differ from their sources, and prototypes are not unit."""
    with torch.no_grad():
        for parameter in loss.parameters():
            parameter.add_(0.05 * torch.randn_like(parameter))


def require_gradients(loss, gradients: list, tolerance: float = 1e-6) -> None:
    for (name, parameter), expected in zip(loss.named_parameters(), gradients, strict=True):
        torch.testing.assert_close(parameter.grad, expected, rtol=1e-3, atol=tolerance, msg=name)


def released_proto(loss: ProtoLoss, td: TensorDict, *, alpha: float, w: float, tau: float):
    """liuxin0824/CRPTpro proto.py ``update_proto``, on copies of the same parameters; returns terms and gradients."""
    encoder, projector, predictor = (copy.deepcopy(m) for m in (loss.encoder, loss.projector, loss.predictor))
    target_encoder, target_projector = copy.deepcopy(encoder), copy.deepcopy(projector)
    target_encoder.load_state_dict(target_state(loss, "encoder"))
    target_projector.load_state_dict(target_state(loss, "projector"))
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


@pytest.mark.parametrize("options", [{}, {"intr_loss_coef": 3.0, "offset": 2.0, "temperature": 0.3}])
def test_proto_equals_the_released_update_in_value_and_gradients(options: dict) -> None:
    loss, td = proto(**options), image_batch(12)
    disturb(loss)
    settings = {"intr_loss_coef": 5e-3, "offset": 1.5, "temperature": 0.1, **options}
    comp, intr, gradients = released_proto(
        loss.before_update(),
        td,
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
    require_gradients(loss, gradients)


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


def test_given_networks_are_trained_and_must_share_one_latent_length() -> None:
    encoder, predictor, prototypes = small_encoder(), Predictor(6, 8), Prototypes(10, 6)
    projector = Projector(encoder.feature_dim, 6)
    loss = ProtoLoss(encoder, projector=projector, predictor=predictor, prototypes=prototypes)
    given = (encoder, projector, predictor, prototypes)
    assert (loss.encoder, loss.projector, loss.predictor, loss.prototypes) == given
    assert {id(p) for p in loss.parameters()} == {id(p) for module in given for p in module.parameters()}
    with pytest.raises(ValueError, match=r"projector 6, predictor 6, prototypes 4; pass latent_dim="):
        proto(prototypes=Prototypes(10, 4))
    mute = torch.nn.Linear(encoder.feature_dim, 6)
    assert proto(projector=mute)(image_batch())["loss_comp"].isfinite()
    with pytest.raises(ValueError, match="projector 6, anchor_head 128"):
        ATCLoss(small_encoder(), projector=projector)
    head = ATCLoss(encoder, projector=projector, anchor_head=AnchorHead(6, 8))
    assert (head.latent_dim, head.hidden_dim) == (6, 8)


def test_targets_start_as_copies_and_feed_only_the_assignments() -> None:
    loss, td = proto(), image_batch()
    for name, module in (("encoder", loss.encoder), ("projector", loss.projector)):
        state = target_state(loss, name)
        assert state.keys() == module.state_dict().keys()
        assert all(torch.equal(state[key], value) for key, value in module.state_dict().items())
    before = loss(td)
    for value in target_state(loss, "encoder").values():
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


@pytest.mark.parametrize(
    ("make", "options", "message"),
    [
        (proto, {"offset": 1.0}, "`offset` must exceed 1"),
        (proto, {"temperature": 0.0}, "`temperature` must be positive"),
        (proto, {"assignment_temperature": -1.0}, "`assignment_temperature` must be positive"),
        (proto, {"sinkhorn_iterations": 2.5}, "`sinkhorn_iterations` must be a whole number"),
        (proto, {"intr_loss_coef": float("nan")}, "`intr_loss_coef` must be finite"),
        (simclr, {"temperature": 0}, "`temperature` must be positive, got 0"),
        (becl, {"temperature": -1}, "`temperature` must be positive, got -1"),
    ],
)
def test_impossible_options_are_refused_by_name(make, options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make(**options)


def test_a_missing_entry_is_named() -> None:
    with pytest.raises(KeyError, match=r"\('next', 'pixels'\)"):
        proto()(TensorDict({"pixels": image_batch()["pixels"]}, [6]))
    with pytest.raises(KeyError, match="pixels_view"):
        simclr()(view_batch().exclude("pixels_view"))
    with pytest.raises(KeyError, match="skill"):
        becl()(skill_image_batch().exclude("skill"))


def released_atc(loss: ATCLoss, td: TensorDict):
    """rlpyt ``augmented_temporal_contrast.py`` and ``atc_models.py`` on copies of the parameters."""
    encoder, projector, head = (copy.deepcopy(m) for m in (loss.encoder, loss.projector, loss.anchor_head))
    target_encoder, target_projector = copy.deepcopy(encoder), copy.deepcopy(projector)
    target_encoder.load_state_dict(target_state(loss, "encoder"))
    target_projector.load_state_dict(target_state(loss, "projector"))
    anchor = projector(encoder(td["pixels"]))
    with torch.no_grad():
        positive = target_projector(target_encoder(td["next", "pixels"]))
    mlp = torch.nn.Sequential(head.hidden, torch.nn.ReLU(), head.output)
    anchor = anchor + mlp(anchor)
    logits = torch.matmul(head.bilinear(anchor), positive.T)
    logits = logits - torch.max(logits, dim=1, keepdim=True)[0]
    value = F.cross_entropy(logits, torch.arange(len(logits)))
    value.backward()
    return value.detach(), [p.grad for m in (encoder, projector, head) for p in m.parameters()]


def released_simclr(loss: SimCLRLoss, td: TensorDict):
    """The authors' InfoNCE over 2B views: the positive is moved to column 0 of the logits."""
    encoder, projector = copy.deepcopy(loss.encoder), copy.deepcopy(loss.projector)
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
    value.backward()
    return value.detach(), [p.grad for m in (encoder, projector) for p in m.parameters()]


def released_becl(loss: BeCLLoss, td: TensorDict):
    """Rooshy-yang/BeCL ``agent/becl.py`` on copies of the parameters."""
    encoder, head = copy.deepcopy(loss.encoder), copy.deepcopy(loss.projector)
    embed = torch.nn.Sequential(
        head.embed_input, torch.nn.ReLU(), head.embed_hidden, torch.nn.ReLU(), head.embed_output
    )
    project = torch.nn.Sequential(head.project_hidden, torch.nn.ReLU(), head.project_output)
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
    value.backward()
    return value.detach(), [p.grad for m in (encoder, head) for p in m.parameters()]


@pytest.mark.parametrize(
    ("make", "batch", "released"),
    [
        (atc, image_batch, released_atc),
        (simclr, view_batch, released_simclr),
        (becl, skill_image_batch, released_becl),
    ],
)
def test_contrastive_losses_and_gradients_equal_the_released_updates(make, batch, released) -> None:
    loss, td = make(), batch(11)
    disturb(loss)
    expected, gradients = released(loss, td)
    value = loss(td)["loss_contrast"]
    torch.testing.assert_close(value.detach(), expected)
    value.backward()
    require_gradients(loss, gradients, 1e-5)


def test_the_gradient_reaches_the_anchors_of_atc_and_both_views_of_simclr() -> None:
    td = image_batch(6).apply(lambda pixels: (pixels / 255).requires_grad_())
    atc()(td)["loss_contrast"].backward()
    assert td["pixels"].grad.any()
    assert td["next", "pixels"].grad is None
    td = view_batch(4).apply(lambda pixels: (pixels / 255).requires_grad_())
    simclr()(td)["loss_contrast"].backward()
    assert td["pixels"].grad.any()
    assert td["pixels_view"].grad.any()


def test_contrastive_losses_have_the_heads_and_entries_of_their_papers() -> None:
    loss = ATCLoss(PixelEncoder())
    sizes = [
        sum(p.numel() for p in getattr(loss, f"{name}_params").parameters()) for name in loss.network_names
    ]
    assert sizes == [30_368, 5_017_728, 148_096]
    assert loss.projector.linear.weight.std().item() == pytest.approx((2 / 39_200) ** 0.5, rel=0.01)
    views = SimCLRLoss(PixelEncoder())
    assert views.projector.config["latent_dim"] == 128
    assert views.temperature.item() == 0.07
    assert views.views == {"pixels_view": "pixels"}
    views.set_keys(observation=("next", "pixels"), observation_view=("next", "pixels_view"))
    assert views.views == {("next", "pixels_view"): ("next", "pixels")}
    assert views.in_keys == [("next", "pixels"), ("next", "pixels_view")]
    skills = becl()
    assert skills.in_keys == [("next", "pixels"), "skill"]
    assert skills.projector(skills.encoder(skill_image_batch(4)["next", "pixels"])).shape == (4, SKILLS)
    assert skills.skill_dim == SKILLS
