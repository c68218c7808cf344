from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from original_agents import CRPTPRO, PIXELS, PROTO, URLB, atc_forward, atc_state, module_file, save
from tensordict import TensorDict
from torch.testing import assert_close

from crptpro.errors import PretrainedError
from crptpro.modules import PixelEncoder
from crptpro.objectives import ProtoLoss
from crptpro.pretrained import (
    import_snapshot,
    load_pretrained,
    random_pretrained,
    rebuild_loss,
    save_pretrained,
)

FORMATS = pytest.mark.parametrize("is_legacy", [False, True], ids=["zip", "legacy"])


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(0)


def equal_states(ours: Any, theirs: Any) -> bool:
    """Same tensors in the same order, whatever they are called."""
    one, two = list(ours.state_dict().values()), list(theirs.state_dict().values())
    return len(one) == len(two) and all(torch.equal(a, b) for a, b in zip(one, two))


@FORMATS
@pytest.mark.parametrize(("source", "method"), [(PROTO, "proto-rl-s"), (CRPTPRO, "released-code")])
def test_an_agent_of_proto_rl_or_crptpro_becomes_an_artifact(
    source: str, method: str, is_legacy: bool, tmp_path: Path
) -> None:
    with module_file(tmp_path / "repository", "proto", source) as proto:
        agent = proto.ProtoAgent()
        file = save(agent, tmp_path / "expl_agent_100000.pt", is_legacy=is_legacy)
        features, latents = agent.encoder.encode(PIXELS), agent.encoder(PIXELS)
    loaded = load_pretrained(import_snapshot(file, tmp_path / "encoder"), expect={"prototypes": True})
    assert_close(loaded.encoder(PIXELS), features, rtol=1e-5, atol=1e-5)
    assert_close(loaded.projector(loaded.encoder(PIXELS)), latents, rtol=1e-5, atol=1e-5)
    assert equal_states(loaded.encoder, agent.encoder.conv)
    assert equal_states(loaded.projector, agent.encoder.projector)
    assert equal_states(loaded.predictor, agent.proto.predictor)
    assert equal_states(loaded.prototypes, agent.proto.protos)
    assert equal_states(loaded.target_encoder, agent.encoder_target.conv)
    assert equal_states(loaded.target_projector, agent.encoder_target.projector)
    # The row that is overwritten next comes first.
    assert torch.equal(loaded.queue, torch.cat([agent.proto.queue[16:], agent.proto.queue[:16]]))
    card = loaded.card
    assert card["method"] == method
    assert card["pixels"]["pixel_offset"] == 0.0
    assert card["loss"]["config"]["temperature"] == 0.2
    assert card["loss"]["config"]["intr_loss_coef"] == (0.0 if method == "proto-rl-s" else 5e-3)
    facts = card["imported"]
    assert (facts["layout"], facts["agent_class"]) == ("proto", "proto.ProtoAgent")
    assert facts["file"] == "expl_agent_100000.pt"
    assert facts["networks"] == [
        "encoder", "predictor", "projector", "prototypes", "queue", "target_encoder", "target_projector",
    ]  # fmt: skip
    assert {"actor", "log_alpha", "proto_optimizer"} <= set(facts["left"])
    assert facts["settings"]["lr"] == 1e-4
    assert facts["settings"]["task_agnostic"] is True


@FORMATS
def test_a_snapshot_of_becl_becomes_an_artifact_with_its_pixel_offset(
    is_legacy: bool, tmp_path: Path
) -> None:
    with module_file(tmp_path / "repository", "agent.becl", URLB) as becl:
        agent = becl.BECLAgent()
        payload = {"agent": agent, "_global_step": 1_000_000, "_global_episode": 2_000}
        file = save(payload, tmp_path / "snapshot_2000000.pt", is_legacy=is_legacy)
        features = agent.encoder(PIXELS)
        latents = agent.becl(features)
    loaded = load_pretrained(import_snapshot(file, tmp_path / "encoder"), expect={"pixel_offset": 0.5})
    assert_close(loaded.encoder(PIXELS), features, rtol=1e-5, atol=1e-5)
    assert_close(loaded.projector(loaded.encoder(PIXELS)), latents, rtol=1e-5, atol=1e-5)
    assert equal_states(loaded.encoder, agent.encoder)
    assert equal_states(loaded.projector, agent.becl)
    assert (loaded.method, loaded.card["loss"]["config"]["temperature"]) == ("becl", 0.4)
    facts = loaded.card["imported"]
    assert (facts["agent_steps"], facts["episodes"]) == (1_000_000, 2_000)
    assert facts["left"] == ["actor", "encoder_opt"]
    with pytest.raises(PretrainedError, match="no prototypes"):
        loaded.require(prototypes=True)


def test_urlbs_own_proto_and_its_agents_without_a_known_head_are_read_too(tmp_path: Path) -> None:
    with module_file(tmp_path / "repository", "agent.ddpg", URLB) as urlb:
        proto, ddpg = urlb.ProtoAgent(), urlb.DDPGAgent()
        for name, agent in (("proto", proto), ("ddpg", ddpg)):
            save({"agent": agent}, tmp_path / f"{name}.pt", is_legacy=False)
    loaded = load_pretrained(import_snapshot(tmp_path / "proto.pt", tmp_path / "one"))
    assert loaded.method == "proto-rl-s"
    assert loaded.encoder.config["pixel_offset"] == 0.5
    assert equal_states(loaded.projector, proto.predictor)
    assert equal_states(loaded.target_projector, proto.predictor_target)
    assert equal_states(loaded.predictor, proto.projector)
    assert torch.equal(loaded.queue, proto.queue.roll(-16, 0))
    assert loaded.card["loss"]["config"]["temperature"] == 0.2
    loaded = load_pretrained(import_snapshot(tmp_path / "ddpg.pt", tmp_path / "two"))
    assert (loaded.method, loaded.projector) == ("urlb-ddpg", None)
    assert equal_states(loaded.encoder, ddpg.encoder)
    with pytest.raises(PretrainedError, match="no registered method"):
        rebuild_loss(loaded)


@FORMATS
@pytest.mark.parametrize(
    ("strides", "features", "method"),
    [((2, 2, 2, 1), 4 * 7 * 7, "atc-native"), ((2, 1, 1, 1), 4 * 35 * 35, "atc")],
)
def test_state_dicts_of_atc_become_an_artifact_with_strides_told_by_the_head(
    strides: tuple[int, ...], features: int, method: str, is_legacy: bool, tmp_path: Path
) -> None:
    state = atc_state(strides, features)
    algo = state["algo_state_dict"]
    file = save(state, tmp_path / "params.pkl", is_legacy=is_legacy)
    loaded = load_pretrained(import_snapshot(file, tmp_path / "encoder"))
    assert loaded.method == method
    assert loaded.encoder.strides == strides
    latents, flat = atc_forward(algo["encoder"], PIXELS, strides)
    assert_close(loaded.encoder(PIXELS), flat, rtol=1e-5, atol=1e-5)
    assert_close(loaded.projector(loaded.encoder(PIXELS)), latents, rtol=1e-5, atol=1e-5)
    target, _ = atc_forward(algo["target_encoder"], PIXELS, strides)
    assert_close(loaded.target_projector(loaded.target_encoder(PIXELS)), target, rtol=1e-5, atol=1e-5)
    assert loaded.card["imported"]["updates"] == 9_999
    head = rebuild_loss(loaded).anchor_head
    anchor, contrast = torch.randn(3, 8), algo["contrast"]
    hidden = torch.relu(
        anchor @ contrast["anchor_mlp.model.0.weight"].T + contrast["anchor_mlp.model.0.bias"]
    )
    residual = anchor + hidden @ contrast["anchor_mlp.model.2.weight"].T + contrast["anchor_mlp.model.2.bias"]
    assert_close(head(anchor), residual @ contrast["W.weight"].T)


@pytest.mark.parametrize("kind", ["crptpro", "becl", "atc"])
def test_training_goes_on_from_an_imported_artifact(kind: str, tmp_path: Path) -> None:
    if kind == "atc":
        file = save(atc_state(), tmp_path / "params.pkl", is_legacy=False)
    else:
        module, source = ("proto", CRPTPRO) if kind == "crptpro" else ("agent.becl", URLB)
        with module_file(tmp_path / "repository", module, source) as repository:
            agent = repository.ProtoAgent() if kind == "crptpro" else {"agent": repository.BECLAgent()}
            file = save(agent, tmp_path / "snapshot.pt", is_legacy=False)
    loaded = load_pretrained(import_snapshot(file, tmp_path / "encoder"))
    loss = rebuild_loss(loaded)
    assert all(torch.equal(a, b) for a, b in zip(loss.encoder.parameters(), loaded.encoder.parameters()))
    for role, state in loss.target_state().items():
        stored = getattr(loaded, f"target_{role}").state_dict()
        assert all(torch.equal(state[name], value) for name, value in stored.items())
    skill = torch.eye(6)[[0, 0, 1]]
    out = loss(TensorDict({"pixels": PIXELS, "next": {"pixels": PIXELS.roll(1, -1)}, "skill": skill}, [3]))
    sum(value for name, value in out.items() if name.startswith("loss_")).backward()
    assert sum(float(p.grad.abs().sum()) for p in loss.encoder.parameters()) > 0
    again = load_pretrained(save_pretrained(loss, tmp_path / "again"))
    assert torch.equal(again.encoder(PIXELS), loaded.encoder(PIXELS))


def refused(path: Path, tmp_path: Path, match: str, **options: Any) -> None:
    out = tmp_path / "never_written"
    with pytest.raises(PretrainedError, match=match) as caught:
        import_snapshot(path, out, **options)
    assert str(path) in str(caught.value)
    assert "crptpro export" in str(caught.value)  # what can be imported
    assert not out.exists()
    assert not [child for child in tmp_path.iterdir() if "never_written" in child.name]


def test_files_that_are_no_snapshot_are_refused(tmp_path: Path) -> None:
    refused(tmp_path / "missing.pt", tmp_path, "No such file")
    (tmp_path / "folder").mkdir()
    refused(tmp_path / "folder", tmp_path, "Is a directory")
    artifact = save_pretrained(
        random_pretrained(channels=(4,), strides=(2,), image_size=16), tmp_path / "ours"
    )
    refused(artifact, tmp_path, "Is a directory")
    for name in ("weights.safetensors", "card.json"):
        refused(artifact / name, tmp_path, "no file that torch.save wrote")
    (tmp_path / "empty.pt").touch()
    refused(tmp_path / "empty.pt", tmp_path, "it is empty")
    (tmp_path / "text.pt").write_text("episode,episode_reward,step\n1,2,3\n" * 50)
    refused(tmp_path / "text.pt", tmp_path, "no file that torch.save wrote")


@FORMATS
def test_tensors_of_something_else_are_refused(is_legacy: bool, tmp_path: Path) -> None:
    def attempt(content: Any, match: str) -> None:
        refused(save(content, tmp_path / "other.pt", is_legacy=is_legacy), tmp_path, match)

    encoder = PixelEncoder(channels=(4, 4), strides=(2, 1), image_size=16)
    attempt(encoder.state_dict(), "no encoder in it")
    attempt({"encoder": encoder.state_dict()}, "other names")
    attempt({"agent": 3}, "neither an agent nor state dicts")
    attempt([torch.zeros(3)], "neither an agent nor state dicts")
    attempt(torch.zeros(3), "neither an agent nor state dicts")
    # RAD's actor_N.pt: one flat state dict of an actor with its encoder inside.
    rad = {"encoder.convs.0.weight": torch.zeros(32, 9, 3, 3), "encoder.convs.0.bias": torch.zeros(32)}
    attempt({**rad, "trunk.0.weight": torch.zeros(4, 4)}, "no encoder in it")
    attempt(ProtoLoss(encoder, num_prototypes=8, latent_dim=8, hidden_dim=8).state_dict(), "no encoder in it")


@FORMATS
@pytest.mark.parametrize("kept", [0.1, 0.5, 0.95, 0.999])
def test_a_truncated_snapshot_is_refused(kept: float, is_legacy: bool, tmp_path: Path) -> None:
    file = save(atc_state(), tmp_path / "params.pkl", is_legacy=is_legacy)
    content = file.read_bytes()
    file.write_bytes(content[: int(kept * len(content))])
    refused(file, tmp_path, "damaged|truncated")


def test_networks_that_this_library_does_not_have_are_refused(tmp_path: Path) -> None:
    def attempt(edit: Any, match: str) -> None:
        state = atc_state()
        edit(state["algo_state_dict"])
        refused(save(state, tmp_path / "params.pkl", is_legacy=False), tmp_path, match)

    big = torch.zeros(4, 9, 8, 8)
    attempt(lambda s: s["encoder"].update({"conv.conv.0.weight": big}), "not all 3x3")
    attempt(lambda s: s["encoder"].update({"conv.conv.0.weight": torch.zeros(4, 4, 3, 3)}), "RGB")
    attempt(lambda s: s["encoder"].update({"conv.conv.1.weight": torch.zeros(4)}), "more than it should")
    # A second layer of the head, a wider anchor network: silently dropping it would make another network.
    attempt(lambda s: s["encoder"].update({"head.model.2.weight": torch.zeros(8, 8)}), "more than it should")
    attempt(lambda s: s["contrast"].pop("W.weight"), "lacks 'W.weight'")
    attempt(lambda s: s["encoder"].update({"head.model.0.weight": torch.zeros(8, 100)}), "100 features.*none")
    # 16 x 16 maps would come of either: 84 -> 41 -> 39 -> 19 -> 17 and 84 -> 82 -> 40 -> 19 -> 17.
    ambiguous = {"head.model.0.weight": torch.zeros(8, 4 * 17 * 17)}
    attempt(lambda s: s["encoder"].update(ambiguous), r"\(1, 2, 2, 1\) or \(2, 1, 2, 1\)")
    attempt(lambda s: s["encoder"]["conv.conv.2.weight"].fill_(float("nan")), "finite")
    attempt(lambda s: s["target_encoder"].pop("conv.conv.2.bias"), "target_encoder lacks 'conv.conv.2.bias'")
    attempt(
        lambda s: s["target_encoder"].update({"conv.conv.2.bias": torch.zeros(3)}),
        r"shape \(3,\), not \(4,\)",
    )
    file = save(atc_state(), tmp_path / "params.pkl", is_legacy=False)
    refused(file, tmp_path, "layout is 'atc', not 'proto'", layout="proto")


def test_an_agent_on_states_and_one_with_padded_convolutions_are_refused(tmp_path: Path) -> None:
    padded = PROTO.replace("nn.Conv2d(9, c, 3, stride=2)", "nn.Conv2d(9, c, 3, stride=2, padding=1)")
    with module_file(tmp_path / "one", "proto", padded) as proto:
        file = save(proto.ProtoAgent(), tmp_path / "padded.pt", is_legacy=False)
    refused(file, tmp_path, "padded")
    states = URLB.replace('"pixels"', '"states"').replace(
        "self.encoder = Encoder()", "self.encoder = nn.Linear(1, 1)"
    )
    with module_file(tmp_path / "two", "agent.ddpg", states) as urlb:
        file = save({"agent": urlb.DDPGAgent()}, tmp_path / "states.pt", is_legacy=False)
    refused(file, tmp_path, "saw states")


def test_another_directory_is_not_replaced(tmp_path: Path) -> None:
    file = save(atc_state(), tmp_path / "params.pkl", is_legacy=False)
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "eval.csv").write_text("precious")
    with pytest.raises(PretrainedError, match="not replaced"):
        import_snapshot(file, tmp_path / "run")
    assert [child.name for child in (tmp_path / "run").iterdir()] == ["eval.csv"]
