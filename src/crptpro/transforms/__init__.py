"""TorchRL transforms: augmentation, frozen features, and exploration bonuses."""

from crptpro.transforms.color_swap import ColorSwap, swap_colors
from crptpro.transforms.dense_features import DenseShiftFeatures
from crptpro.transforms.dense_shift import crop_features, dense_shift_geometry, dense_shift_maps
from crptpro.transforms.frozen_encoder import FrozenEncoder
from crptpro.transforms.intrinsic_reward import IntrinsicReward
from crptpro.transforms.particle_reward import ParticleReward
from crptpro.transforms.prototype_reward import PrototypeReward
from crptpro.transforms.random_shift import RandomShift, draw_offsets, random_shift
from crptpro.transforms.shift_cache import DenseShiftCache, choose_feature_mode
from crptpro.transforms.skill_contrast_reward import SkillContrastReward

__all__ = [
    "ColorSwap",
    "DenseShiftCache",
    "DenseShiftFeatures",
    "FrozenEncoder",
    "IntrinsicReward",
    "ParticleReward",
    "PrototypeReward",
    "RandomShift",
    "SkillContrastReward",
    "choose_feature_mode",
    "crop_features",
    "dense_shift_geometry",
    "dense_shift_maps",
    "draw_offsets",
    "random_shift",
    "swap_colors",
]
