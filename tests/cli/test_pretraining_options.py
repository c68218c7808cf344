"""What the commands that pre-train may vary beside the paper's settings."""

from __future__ import annotations

from pathlib import Path

from command import SIZE, Call, refused, toy_dataset

from crptpro.pretrained import load_pretrained


def test_pretraining_takes_a_schedule_of_domains(call: Call, dataset: Path, tmp_path: Path) -> None:
    other, out = toy_dataset(tmp_path / "data" / "other", SIZE), tmp_path / "out"
    common = ("pretrain", dataset, other, "--out", out, "--updates", 2, "--domain-schedule", "mixed")
    assert "got 1 and 2" in refused(call(*common, "--batch-size", 1))
    assert call(*common, "--batch-size", 4)[0] == 0
    assert load_pretrained(out / "encoder").card["training"]["settings"]["domain_schedule"] == "mixed"
    line = refused(call("pretrain", "walker", "--method", "apt-s", "--out", out, *common[-2:]))
    assert "--domain-schedule is for methods that learn from datasets; leave it out" in line


def test_finetuning_goes_on_with_the_moments_of_a_run(call: Call, dataset: Path, tmp_path: Path) -> None:
    runs, few = tmp_path / "runs", ("--updates", 2, "--batch-size", 4)
    assert call("pretrain", dataset, "--out", runs / "first", *few)[0] == 0
    encoder = runs / "first" / "encoder"
    kept = ("finetune", encoder, dataset, "--out", runs / "kept", *few, "--optimizer-state-from")
    line = refused(call(*kept, encoder))
    assert f"{encoder} is no run directory with checkpoints. Did you mean {runs / 'first'}?" in line
    assert call(*kept, runs / "first")[0] == 0
    assert call("finetune", encoder, dataset, "--out", runs / "fresh", *few)[0] == 0
    one, two = (load_pretrained(runs / name / "encoder") for name in ("kept", "fresh"))
    assert one.card["training"]["started_from"] == two.card["training"]["started_from"]
    assert one.identity() != two.identity()
