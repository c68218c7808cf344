"""Where the original repositories keep the networks that this library has, and under which names."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from crptpro.modules.initialisation import WeightInit

LayoutFamily = Literal["proto", "urlb", "atc"]


@dataclass(frozen=True)
class Head:
    """One of our heads in theirs.

    Attributes:
        section: their network, an attribute of their agent.
        layers: name of a layer of ours to its name in that network; ``""`` is the network itself.
    """

    section: str
    layers: dict[str, str]


@dataclass(frozen=True)
class Layout:
    """Names of one repository's snapshots.

    Attributes:
        name: of the layout.
        family: what the command line calls it.
        source: the repository.
        trunk: the ``Sequential`` of convolutions and ReLUs in the section ``encoder``.
        pixel_offset: subtracted from pixels / 255 there.
        init: how encoder and projector are drawn there.
        heads: ours by our name.
        targets: their section to the one with its slow copy.
        queue: section and name of the candidate queue.
    """

    name: str
    family: LayoutFamily
    source: str
    trunk: str
    pixel_offset: float = 0.0
    init: WeightInit = "orthogonal"
    heads: dict[str, Head] = field(default_factory=dict)
    targets: dict[str, str] = field(default_factory=dict)
    queue: tuple[str, str] | None = None


PROTO = Layout(
    "proto",
    "proto",
    "denisyarats/proto, liuxin0824/CRPTpro",
    trunk="conv",
    heads={
        "projector": Head("encoder", {"linear": "projector"}),
        "predictor": Head("proto", {"hidden": "predictor.0", "output": "predictor.2"}),
        "prototypes": Head("proto", {"": "protos"}),
    },
    targets={"encoder": "encoder_target"},
    queue=("proto", "queue"),
)
# What Proto-RL calls the projector is the predictor there, and the other way round.
URLB_PROTO = Layout(
    "urlb-proto",
    "urlb",
    "rll-research/url_benchmark, agent proto",
    trunk="convnet",
    pixel_offset=0.5,
    heads={
        "projector": Head("predictor", {"linear": ""}),
        "predictor": Head("projector", {"hidden": "trunk.0", "output": "trunk.2"}),
        "prototypes": Head("protos", {"": ""}),
    },
    targets={"encoder": "encoder_target", "predictor": "predictor_target"},
    queue=("queue", ""),
)
BECL = Layout(
    "becl",
    "urlb",
    "Rooshy-yang/BeCL",
    trunk="convnet",
    pixel_offset=0.5,
    heads={
        "projector": Head(
            "becl",
            {
                "embed_input": "embed.0",
                "embed_hidden": "embed.2",
                "embed_output": "embed.4",
                "project_hidden": "project_head.0",
                "project_output": "project_head.2",
            },
        ),
    },
)
URLB = Layout("urlb", "urlb", "rll-research/url_benchmark", trunk="convnet", pixel_offset=0.5)
ATC = Layout(
    "atc",
    "atc",
    "astooke/rlpyt, rlpyt/ul",
    trunk="conv.conv",
    init="kaiming",
    heads={
        "projector": Head("encoder", {"linear": "head.model.0"}),
        "anchor_head": Head(
            "contrast", {"hidden": "anchor_mlp.model.0", "output": "anchor_mlp.model.2", "bilinear": "W"}
        ),
    },
    targets={"encoder": "target_encoder"},
)


def join(*parts: str) -> str:
    """Return a state-dict name from its non-empty parts.

    Examples:
        >>> join("trunk.0", "weight"), join("", "weight")
        ('trunk.0.weight', 'weight')
    """
    return ".".join(part for part in parts if part)
