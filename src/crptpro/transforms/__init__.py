"""TorchRL transforms: augmentation, frozen features, and intrinsic rewards."""

from crptpro.transforms.color_swap import ColorSwap
from crptpro.transforms.dense_shift import DenseShiftFeatures, choose_feature_mode
from crptpro.transforms.frozen_encoder import FrozenEncoder
from crptpro.transforms.random_shift import RandomShift, draw_offsets, random_shift
from crptpro.transforms.rewards import ContrastiveReward, ParticleReward, PrototypeReward

__all__ = [
    "ColorSwap", "ContrastiveReward", "DenseShiftFeatures", "FrozenEncoder", "ParticleReward", "PrototypeReward",
    "RandomShift", "choose_feature_mode", "draw_offsets", "random_shift",
]  # fmt: skip
