"""The artifact between the two halves: a pre-trained encoder, its heads and a card; fine-tuning from it."""

from crptpro.pretrained.bundle import Pretrained, random_pretrained
from crptpro.pretrained.finetuning import finetune, rebuild_loss
from crptpro.pretrained.loading import load_pretrained
from crptpro.pretrained.saving import save_pretrained

__all__ = [
    "Pretrained",
    "finetune",
    "load_pretrained",
    "random_pretrained",
    "rebuild_loss",
    "save_pretrained",
]
