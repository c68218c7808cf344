"""The methods that come with the library."""

from __future__ import annotations

from dataclasses import replace

from crptpro.objectives.atc import ATCLoss
from crptpro.objectives.becl import BeCLLoss
from crptpro.objectives.exploration import ExplorationDefaults
from crptpro.objectives.proto import ProtoLoss
from crptpro.objectives.registry import MethodDefaults, mark_builtin, register_method
from crptpro.objectives.simclr import SimCLRLoss

# The first method of a class is what a loss of that class built by hand is trained like.
register_method("crptpro", ProtoLoss, MethodDefaults())
# Deviation: targets at half the student's temperature, which leave the plateau at ln M sooner, and three times the
# learning rate, which gets further once it is left (docs/study.md).
register_method(
    "crptpro-fast",
    ProtoLoss,
    MethodDefaults(lr=3e-4),
    loss_options={"assignment_temperature": 0.05},
    is_preset=True,
)
# The authors' published code where it differs from the paper: predictor width, and 3 x 16,666 updates.
register_method(
    "released-code",
    ProtoLoss,
    MethodDefaults(updates=49_998),
    loss_options={"hidden_dim": 512},
    is_preset=True,
)

# ATC's own loss, head and schedule on the trunk (orthogonal weights), batch and budget that all methods share.
_ATC = MethodDefaults(
    lr=1e-3, encoder_tau=0.01, schedule="warmup_cosine", warmup_updates=1_000, grad_clip=10.0
)
register_method("atc", ATCLoss, _ATC)
register_method(
    "atc-native",
    ATCLoss,
    replace(_ATC, batch_size=256),
    is_preset=True,
    encoder_options={"strides": (2, 2, 2, 1), "init": "kaiming"},
)

# Active methods: four simulator steps per encoder update, 200,000 in total over a group (C) or 500,000 in one
# domain (S). The paper's efficiency table has equal times for one to three domains, so (C) counts in total.
_APT = ExplorationDefaults(reward="particle", agent="averaged-sac")
register_method("apt-c", SimCLRLoss, MethodDefaults(encoder_tau=None), exploration=_APT)
register_method(
    "apt-s",
    SimCLRLoss,
    MethodDefaults(updates=125_000, encoder_tau=None),
    exploration=replace(_APT, env_steps=500_000, is_single_domain=True),
)
# Deviation: the released code of Proto-RL has a predictor of width 512; the paper's table, which has it beside
# CRPTpro, says 1024.
_PROTO_RL = {"intr_loss_coef": 0.0}
register_method(
    "proto-rl-c",
    ProtoLoss,
    loss_options=_PROTO_RL,
    replay_capacity=100_000,
    exploration=ExplorationDefaults(),
)
register_method(
    "proto-rl-s",
    ProtoLoss,
    MethodDefaults(updates=125_000),
    loss_options=_PROTO_RL,
    replay_capacity=100_000,
    exploration=ExplorationDefaults(env_steps=500_000, is_single_domain=True, transfers_actor=True),
)
# An update of BeCL's agent every second agent step brings three encoder updates: 150,000 for 50,000 of the agent.
register_method(
    "becl",
    BeCLLoss,
    MethodDefaults(updates=150_000, encoder_tau=None),
    encoder_options={"pixel_offset": 0.5},
    exploration=ExplorationDefaults(
        reward="skill-contrast",
        agent="skill-ddpg",
        encoder_updates_each=3,
        encodes_before_update=True,
        agent_update_interval=2,
        n_step=3,
        skill_dim=16,
        random_agent_steps=2_000,
    ),
)
mark_builtin()
