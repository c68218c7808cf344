from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest
import torch
from original_agents import CRPTPRO, PIXELS, URLB, atc_state, module_file, save

from crptpro.errors import DiskSpaceError, PretrainedError
from crptpro.modules import PixelEncoder
from crptpro.objectives import ATCLoss, BeCLLoss, ProtoLoss
from crptpro.pretrained import (
    Pretrained,
    export_state_dict,
    import_snapshot,
    load_pretrained,
    random_pretrained,
    save_pretrained,
    write_state_dict,
)

CHANNELS: dict[str, Any] = {"channels": (4, 4, 4, 4)}


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(0)


def artifact(kind: str, path: Path, *, image_size: int = 84) -> Pretrained:
    shape = {**CHANNELS, "image_size": image_size}
    if kind == "atc":
        loss: Any = ATCLoss(PixelEncoder(strides=(2, 2, 2, 1), **shape), latent_dim=8, hidden_dim=12)
    elif kind == "becl":
        loss = BeCLLoss(PixelEncoder(pixel_offset=0.5, **shape), skill_dim=6, hidden_dim=10)
    else:
        encoder = PixelEncoder(pixel_offset=0.5 if kind == "urlb-proto" else 0.0, **shape)
        coefficient = 0.0 if kind == "urlb-proto" else 5e-3  # URLB's proto has no dispersion loss
        loss = ProtoLoss(encoder, num_prototypes=16, latent_dim=8, hidden_dim=12, intr_loss_coef=coefficient)
    for state in loss.target_state().values():  # targets lag behind
        for value in state.values():
            value.mul_(0.5)
    loaded = load_pretrained(save_pretrained(loss, path))
    loaded.queue = torch.randn(32, 8) if "proto" in kind else None
    return loaded


@pytest.mark.parametrize(
    ("kind", "layout"), [("proto", "proto"), ("urlb-proto", "urlb"), ("becl", "urlb"), ("atc", "atc")]
)
def test_an_exported_artifact_comes_back_by_import(kind: str, layout: Any, tmp_path: Path) -> None:
    before = artifact(kind, tmp_path / "before")
    file = write_state_dict(export_state_dict(before, layout), tmp_path / "out" / "state.pt")
    assert [child.name for child in file.parent.iterdir()] == ["state.pt"]
    torch.load(file, weights_only=True)  # holds nothing that plain torch would not trust
    after = load_pretrained(import_snapshot(file, tmp_path / "after", layout=layout))
    for role in ("encoder", "projector", "predictor", "prototypes", "target_encoder", "target_projector"):
        one, two = getattr(before, role), getattr(after, role)
        assert (one is None) == (two is None), role
        if one is not None:
            assert one.state_dict().keys() == two.state_dict().keys()
            assert all(torch.equal(value, two.state_dict()[name]) for name, value in one.state_dict().items())
    assert torch.equal(before.encoder(PIXELS), after.encoder(PIXELS))
    assert (before.queue is None) == (after.queue is None)
    assert before.queue is None or torch.equal(before.queue, after.queue)
    assert before.rest.keys() == after.rest.keys()
    assert all(torch.equal(value, after.rest[name]) for name, value in before.rest.items())
    told = {"proto": "crptpro", "urlb-proto": "proto-rl-s", "becl": "becl", "atc": "atc-native"}
    assert after.method == told[kind]


def test_the_originals_modules_load_what_is_exported(tmp_path: Path) -> None:
    state = export_state_dict(ours := artifact("proto", tmp_path / "ours"), "proto")
    with module_file(tmp_path / "one", "proto", CRPTPRO) as proto:
        agent = proto.ProtoAgent()
        agent.encoder.load_state_dict(state["encoder"])
        agent.encoder_target.load_state_dict(state["encoder_target"])
        agent.proto.load_state_dict(state["proto"])
        assert torch.allclose(agent.encoder.encode(PIXELS), ours.encoder(PIXELS), atol=1e-5)
        save(agent, tmp_path / "agent.pt", is_legacy=False)
    again = load_pretrained(import_snapshot(tmp_path / "agent.pt", tmp_path / "again"))
    assert torch.equal(again.prototypes.weight, ours.prototypes.weight)
    assert torch.equal(again.queue, ours.queue)
    with module_file(tmp_path / "two", "agent.becl", URLB) as becl:
        agent = becl.BECLAgent()
        ours = artifact("becl", tmp_path / "becl")
        state = export_state_dict(ours, "urlb")
        agent.encoder.load_state_dict(state["encoder"])
        agent.becl.load_state_dict(state["becl"])
        assert torch.allclose(agent.encoder(PIXELS), ours.encoder(PIXELS), atol=1e-5)
    state = export_state_dict(artifact("atc", tmp_path / "atc"), "atc")["algo_state_dict"]
    for name, expected in atc_state()["algo_state_dict"].items():
        if name != "optimizer":
            assert {k: v.shape for k, v in state[name].items()} == {k: v.shape for k, v in expected.items()}


def test_what_another_code_would_read_wrongly_is_refused(tmp_path: Path) -> None:
    proto, becl, atc = (artifact(kind, tmp_path / kind) for kind in ("proto", "becl", "atc"))
    with pytest.raises(PretrainedError, match=r"pixel_offset is 0.0, theirs 0.5"):
        export_state_dict(proto, "urlb")
    with pytest.raises(PretrainedError, match=r"pixel_offset is 0.5, theirs 0.0.*no predictor"):
        export_state_dict(becl, "proto")
    with pytest.raises(PretrainedError, match=r"strides are \(2, 2, 2, 1\)"):
        export_state_dict(atc, "proto")
    with pytest.raises(PretrainedError, match="no anchor_head"):
        export_state_dict(proto, "atc")
    with pytest.raises(PretrainedError, match="no projector"):
        export_state_dict(random_pretrained(**CHANNELS), "proto")


@pytest.mark.parametrize(("kind", "layout"), [("proto", "proto"), ("becl", "urlb"), ("atc", "atc")])
def test_an_encoder_of_other_images_is_refused(kind: str, layout: Any, tmp_path: Path) -> None:
    large = artifact(kind, tmp_path / kind, image_size=96)
    with pytest.raises(PretrainedError, match=r"does not fit .*: image_size is 96, theirs 84\.$"):
        export_state_dict(large, layout)


def test_a_disk_that_fills_up_keeps_the_old_file(tmp_path: Path) -> None:
    file = write_state_dict({"encoder": {}}, tmp_path / "state.pt")
    before = file.read_bytes()
    (tmp_path / f".state.pt.{os.getpid()}.partial").symlink_to("/dev/full")
    with pytest.raises(DiskSpaceError, match=r"disk is full: .*/state\.pt cannot be written"):
        write_state_dict({"encoder": {"weight": torch.ones(2)}}, file)
    assert file.read_bytes() == before
    assert [child.name for child in tmp_path.iterdir()] == ["state.pt"]


def test_a_place_where_no_file_can_be_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match=r"'.*/file'"):
        write_state_dict({"encoder": {}}, tmp_path / "file" / "state.pt")
    (tmp_path / "folder").mkdir()
    monkeypatch.chdir(tmp_path / "folder")
    for path in (".", tmp_path / "folder"):
        with pytest.raises(PretrainedError, match="is a directory; name a file in it"):
            write_state_dict({"encoder": {}}, path)
    with pytest.raises(OSError, match="name too long: '/"):  # by torch, a RuntimeError of its own
        write_state_dict({"encoder": {}}, tmp_path / ("x" * 250))
