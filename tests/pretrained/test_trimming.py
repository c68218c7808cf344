from __future__ import annotations

from pathlib import Path

import pytest
import torch

from crptpro.artifact import WEIGHTS_FILE
from crptpro.errors import PretrainedError
from crptpro.modules import PixelEncoder, SquashedGaussianActor
from crptpro.objectives import BeCLLoss, ProtoLoss, SimCLRLoss
from crptpro.pretrained import load_pretrained, rebuild_loss, save_pretrained, trim_pretrained

PARTS = ("projector", "predictor", "prototypes", "target_encoder", "target_projector", "queue", "actor")


def encoder() -> PixelEncoder:
    return PixelEncoder(channels=(4, 4), strides=(2, 1), image_size=16)


def states(artifact: object, *roles: str) -> dict[str, torch.Tensor]:
    return {f"{role}.{k}": v for role in roles for k, v in getattr(artifact, role).state_dict().items()}


@pytest.fixture
def prototypical(tmp_path: Path) -> Path:
    torch.manual_seed(0)
    loss = ProtoLoss(encoder(), num_prototypes=8, latent_dim=4, hidden_dim=6)
    actor = SquashedGaussianActor(loss.encoder.feature_dim, 2, bottleneck_dim=5, hidden_dim=8)
    return save_pretrained(loss, tmp_path / "whole", actor=actor)


def test_prototypes_projector_and_actor_stay_and_what_only_training_reads_goes(
    prototypical: Path, tmp_path: Path
) -> None:
    whole = load_pretrained(prototypical)
    trimmed = load_pretrained(trim_pretrained(whole, tmp_path / "trimmed"))
    assert {name for name in PARTS if getattr(trimmed, name) is not None} == {
        "projector",
        "prototypes",
        "actor",
    }
    kept = ("encoder", "projector", "prototypes", "actor")
    before, after = states(whole, *kept), states(trimmed, *kept)
    assert before.keys() == after.keys()
    assert all(torch.equal(before[key], after[key]) for key in before)
    assert not trimmed.rest


def test_whoever_may_read_the_directory_may_read_what_is_in_it(prototypical: Path, tmp_path: Path) -> None:
    path = trim_pretrained(load_pretrained(prototypical), tmp_path / "trimmed")
    assert {file.stat().st_mode & 0o777 for file in path.iterdir()} == {0o644}


def test_a_queue_stays_with_its_prototypes(prototypical: Path, tmp_path: Path) -> None:
    whole = load_pretrained(prototypical)
    whole.queue = torch.randn(16, 4)
    trimmed = load_pretrained(trim_pretrained(whole, tmp_path / "trimmed"))
    assert torch.equal(trimmed.queue, whole.queue)


@pytest.mark.parametrize("loss_class", [SimCLRLoss, BeCLLoss])
def test_without_prototypes_the_encoder_alone_stays(loss_class: type, tmp_path: Path) -> None:
    loss = loss_class(encoder())
    whole = load_pretrained(save_pretrained(loss, tmp_path / "whole"))
    trimmed = load_pretrained(trim_pretrained(whole, tmp_path / "trimmed"))
    assert all(getattr(trimmed, name) is None for name in PARTS)
    assert not trimmed.rest
    pixels = torch.randint(0, 256, (5, 9, 16, 16), dtype=torch.uint8)
    assert torch.equal(trimmed.encoder(pixels), whole.encoder(pixels))
    sizes = [(tmp_path / name / WEIGHTS_FILE).stat().st_size for name in ("whole", "trimmed")]
    assert sizes[1] < sizes[0] / 10


def test_records_name_it_as_the_artifact_it_comes_from_however_often_it_was_trimmed(
    prototypical: Path, tmp_path: Path
) -> None:
    whole = load_pretrained(prototypical)
    once = load_pretrained(trim_pretrained(whole, tmp_path / "trimmed"))
    assert once.identity() == whole.identity()
    assert once.card["weights_sha256"] != whole.card["weights_sha256"]
    twice = load_pretrained(trim_pretrained(once, tmp_path / "trimmed"))
    assert twice.identity() == whole.identity()
    of_its_own = {"weights_sha256", "trimmed_from", "modules"}
    assert {k: v for k, v in once.card.items() if k not in of_its_own} == {
        k: v for k, v in whole.card.items() if k not in of_its_own
    }


def test_training_on_from_it_is_refused(prototypical: Path, tmp_path: Path) -> None:
    trimmed = load_pretrained(trim_pretrained(load_pretrained(prototypical), tmp_path / "trimmed"))
    with pytest.raises(PretrainedError, match=r"was trimmed .* Take the one it comes from"):
        rebuild_loss(trimmed)


def test_an_artifact_in_memory_and_a_foreign_directory_are_refused(
    prototypical: Path, tmp_path: Path
) -> None:
    whole = load_pretrained(prototypical)
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "a.txt").write_text("mine")
    with pytest.raises(PretrainedError, match="not a pretrained artifact; it is not replaced"):
        trim_pretrained(whole, tmp_path / "notes")
    assert (tmp_path / "notes" / "a.txt").read_text() == "mine"
    del whole.card["weights_sha256"]
    with pytest.raises(PretrainedError, match="read from disk"):
        trim_pretrained(whole, tmp_path / "trimmed")
    assert not (tmp_path / "trimmed").exists()
