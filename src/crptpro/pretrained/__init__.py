"""The artifact between the two halves: a pre-trained encoder, its heads and a card; fine-tuning from it."""

from crptpro.pretrained.bundle import Pretrained, random_pretrained
from crptpro.pretrained.exporting import export_state_dict, write_state_dict
from crptpro.pretrained.finetuning import finetune, rebuild_loss
from crptpro.pretrained.importing import import_snapshot
from crptpro.pretrained.loading import load_pretrained
from crptpro.pretrained.saving import save_pretrained
from crptpro.pretrained.snapshots import encoder_snapshots, snapshot_path
from crptpro.pretrained.trimming import trim_pretrained

__all__ = [
    "Pretrained",
    "encoder_snapshots",
    "export_state_dict",
    "finetune",
    "import_snapshot",
    "load_pretrained",
    "random_pretrained",
    "rebuild_loss",
    "save_pretrained",
    "snapshot_path",
    "trim_pretrained",
    "write_state_dict",
]
