"""From the tables of a snapshot to our artifact."""

from __future__ import annotations

import copy
from typing import Any

from torch import Tensor, nn

from crptpro.errors import PretrainedError
from crptpro.modules import PixelEncoder, Projector
from crptpro.modules.heads import latent_dim_of
from crptpro.objectives import ProtoLoss, get_method, methods
from crptpro.pretrained.bundle import ROLES, Pretrained
from crptpro.pretrained.importing.architecture import build_encoder, build_head, fill
from crptpro.pretrained.importing.layouts import Contents
from crptpro.pretrained.importing.names import ATC, BECL, PROTO, URLB, URLB_PROTO, join
from crptpro.pretrained.importing.torch_file import TorchFile
from crptpro.pretrained.saving import describe_loss, rest_state

_ATC_NATIVE_STRIDES = (2, 2, 2, 1)


def to_pretrained(contents: Contents, file: TorchFile) -> Pretrained:
    """Build encoder, heads, targets and queue of a snapshot; the card says what they were and what is left.

    Raises:
        PretrainedError: the reason, as the end of a sentence about the snapshot.
    """
    reader = _Reader(contents, file)
    layout = contents.layout
    head_states = {role: reader.head(role) for role in layout.heads}
    first = next((s for name, s in head_states.get("projector", {}).items() if name.endswith("weight")), None)
    encoder = build_encoder(
        reader.encoder("encoder"),
        pixel_offset=layout.pixel_offset,
        init=layout.init,
        strides=reader.strides(),
        feature_dim=None if first is None else first.shape[-1],
    )
    heads: dict[str, Any] = {
        role: build_head(role, state, layout.init) for role, state in head_states.items()
    }
    targets: dict[str, nn.Module] = {}
    if (section := layout.targets.get("encoder", "")) in contents.sections:
        targets["target_encoder"] = fill(PixelEncoder, encoder.config, reader.encoder(section), section)
        section = layout.targets[layout.heads["projector"].section]
        state = reader.head("projector", section)
        targets["target_projector"] = fill(Projector, heads["projector"].config, state, section)
    queue = reader.queue()
    left = reader.finish()
    latents = {role: latent_dim_of(head) for role, head in heads.items()}
    if queue is not None:
        latents["queue"] = queue.shape[1]
    if len(set(latents.values())) > 1:
        raise PretrainedError(f"its networks have latents of different lengths: {latents}.")
    method = _method_of(contents, encoder)
    card: dict[str, Any] = {"method": method, "training": None}
    rest: dict[str, Tensor] = {}
    if method in methods(presets=True):
        # Built once for its description and its further state; the copies keep the networks as they are.
        loss = get_method(method).build(
            encoder=copy.deepcopy(encoder), **copy.deepcopy(heads), **_options(contents)
        )
        card = describe_loss(loss)
        rest = {name: value.detach().clone() for name, value in rest_state(loss).items()}
    card["imported"] = {
        "layout": layout.name,
        "source": layout.source,
        "agent_class": contents.agent_class,
        "networks": sorted(["encoder", *heads, *targets, *(["queue"] if queue is not None else [])]),
        "left": sorted({*left, *contents.others}),
        "settings": dict(sorted(contents.settings.items())),
        **contents.counters,
    }
    named = {role: module for role, module in heads.items() if role in ROLES}
    return Pretrained(encoder, **named, **targets, queue=queue, card=card, rest=rest)


class _Reader:
    """Takes networks out of the tables under our names and keeps account of what was taken."""

    def __init__(self, contents: Contents, file: TorchFile) -> None:
        self._contents = contents
        self._file = file
        self._taken: dict[str, set[str]] = {}

    def encoder(self, section: str) -> dict[str, Tensor]:
        """Convolutions stand at the even places of a ``Sequential``, ReLUs between them."""
        table = self._contents.sections.get(section, {})
        trunk = self._contents.layout.trunk
        state = {}
        for index in range(len(table)):
            if join(trunk, str(2 * index), "weight") not in table:
                break
            for name in ("weight", "bias"):
                state[f"convs.{index}.{name}"] = self._take(section, join(trunk, str(2 * index), name))
        return state

    def head(self, role: str, section: str | None = None) -> dict[str, Tensor]:
        head = self._contents.layout.heads[role]
        section = head.section if section is None else section
        table = self._contents.sections.get(section, {})
        state = {}
        for ours, theirs in head.layers.items():
            state[join(ours, "weight")] = self._take(section, join(theirs, "weight"))
            if join(theirs, "bias") in table:
                state[join(ours, "bias")] = self._take(section, join(theirs, "bias"))
        return state

    def strides(self) -> tuple[int, ...] | None:
        """Return the strides, if the snapshot has the modules themselves."""
        known = self._contents.strides
        names = [
            name
            for name in self._taken.get("encoder", ())
            if name.startswith(f"{self._contents.layout.trunk}.") and name.endswith(".weight")
        ]
        found = [known.get(join("encoder", name.removesuffix(".weight"))) for name in sorted(names)]
        if None in found or not found:
            return None
        pairs = [tuple(stride) for stride in found if stride is not None]
        if any(len(pair) != 2 or pair[0] != pair[1] or pair[0] not in (1, 2) for pair in pairs):
            raise PretrainedError(f"the strides of its convolutions are {pairs[:8]}, not 1 or 2.")
        return tuple(pair[0] for pair in pairs)

    def queue(self) -> Tensor | None:
        """Return the candidates, the one that is overwritten next at the first place; None if there are none."""
        layout = self._contents.layout
        if layout.queue is None or layout.queue[0] not in self._contents.sections:
            return None
        section, name = layout.queue
        table = self._contents.sections[section]
        if name not in table:
            return None
        queue = self._take(section, name)
        pointer: Any = self._contents.settings.get("queue_ptr", 0)
        if "queue_ptr" in table:
            pointer = self._take(section, "queue_ptr").flatten().tolist()[-1]
        if queue.dim() != 2 or not queue.is_floating_point() or not bool(queue.float().isfinite().all()):
            raise PretrainedError("its queue is no table of finite numbers.")
        if not isinstance(pointer, int) or not 0 <= pointer < len(queue):
            raise PretrainedError(f"its queue has {len(queue)} rows and none of number {pointer}.")
        return queue.float().roll(-pointer, 0)

    def finish(self) -> list[str]:
        """Return the sections that were not touched; refuse what is left in one that was.

        A layer more than expected makes another network.
        """
        sections = self._contents.sections
        for section, names in self._taken.items():
            if left := sorted(sections[section].keys() - names):
                raise PretrainedError(
                    f"its {section} has more than it should: {', '.join(repr(name[:80]) for name in left[:5])}."
                )
        return [section for section in sections if section not in self._taken]

    def _take(self, section: str, name: str) -> Tensor:
        table = self._contents.sections.get(section)
        if table is None:
            raise PretrainedError(f"it has no {section}.")
        if name not in table:
            raise PretrainedError(f"its {section} lacks {name!r}.")
        self._taken.setdefault(section, set()).add(name)
        return self._file.read(table[name])


def _method_of(contents: Contents, encoder: PixelEncoder) -> str:
    """Return the registered method that goes on with such a snapshot, or a name of its own for one without."""
    layout, settings = contents.layout, contents.settings
    if layout is PROTO:
        given = str(settings.get("method"))
        if contents.agent_class is None and given in methods(presets=True):  # of an export
            return given if issubclass(get_method(given).loss_class, ProtoLoss) else "proto-rl-s"
        # The only trace of the fork: it counts its updates.
        return "released-code" if "proto.update_count" in settings else "proto-rl-s"
    if layout is URLB_PROTO:
        return "proto-rl-s"
    if layout is BECL:
        return "becl"
    if layout is ATC:
        return "atc-native" if encoder.strides == _ATC_NATIVE_STRIDES else "atc"
    assert layout is URLB
    name = str(settings.get("name", "agent"))
    return f"urlb-{name}" if name.isidentifier() else "urlb-agent"


def _options(contents: Contents) -> dict[str, Any]:
    """Return the options of our loss that the snapshot tells."""
    told = {PROTO.name: "proto.T", URLB_PROTO.name: "tau", BECL.name: "temperature"}
    temperature = contents.settings.get(told.get(contents.layout.name, ""))
    if isinstance(temperature, (int, float)) and temperature > 0:
        return {"temperature": float(temperature)}
    return {}
