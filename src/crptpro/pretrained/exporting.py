"""An artifact as state dicts under the names of the original repositories."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from crptpro.errors import PretrainedError
from crptpro.pretrained.bundle import Pretrained
from crptpro.pretrained.importing.architecture import IMAGE_SIZE
from crptpro.pretrained.importing.names import ATC, BECL, PROTO, URLB_PROTO, Head, Layout, LayoutFamily, join
from crptpro.whole_file import write_whole

_SHARED_STRIDES = (2, 1, 1, 1)


def export_state_dict(pretrained: Pretrained, layout: LayoutFamily) -> dict[str, Any]:
    """Return an artifact's networks as plain state dicts under an original repository's names.

    ``proto`` gives ``{encoder, encoder_target, proto}`` of denisyarats/proto and liuxin0824/CRPTpro; ``urlb``
    gives ``{encoder, becl}`` of BeCL, or ``{encoder, encoder_target, predictor, predictor_target, projector,
    protos, queue}`` of URLB's proto; ``atc`` gives ``{algo_state_dict: {encoder, target_encoder, contrast}}``.
    Each is for ``load_state_dict`` of the attribute of that name; targets and a queue that the artifact lacks are
    left out. A further entry ``method`` says what trained them.

    Args:
        pretrained: the artifact.
        layout: ``"proto"``, ``"urlb"`` or ``"atc"``.

    Returns:
        Dicts of tensors that share no memory with the artifact.

    Raises:
        PretrainedError: image size, pixel scaling, strides or heads are not what that repository's code has.
    """
    chosen = {"proto": PROTO, "atc": ATC, "urlb": BECL if pretrained.method == "becl" else URLB_PROTO}[layout]
    _require_fit(pretrained, chosen)
    sections: dict[str, dict[str, Tensor]] = {}
    encoders: dict[str, Any] = {"encoder": pretrained.encoder}
    if "encoder" in chosen.targets and pretrained.target_encoder is not None:
        encoders[chosen.targets["encoder"]] = pretrained.target_encoder
    for section, encoder in encoders.items():
        table = sections.setdefault(section, {})
        for index in range(len(encoder.conv_layers)):
            for name in ("weight", "bias"):
                value = encoder.state_dict()[f"convs.{index}.{name}"]
                table[join(chosen.trunk, str(2 * index), name)] = value.clone()
    for role, head in chosen.heads.items():
        _write(sections, head.section, head, _state_of(pretrained, role))
    if (target := pretrained.target_projector) is not None and chosen.targets:
        head = chosen.heads["projector"]
        _write(sections, chosen.targets[head.section], head, target.state_dict())
    exported: dict[str, Any] = dict(sections)
    if chosen.queue is not None and pretrained.queue is not None:
        section, name = chosen.queue
        # Its first row is the next to be overwritten.
        if name:
            sections[section][name] = pretrained.queue.clone()
            sections[section]["queue_ptr"] = torch.zeros(1, dtype=torch.long)
        else:
            exported[section] = pretrained.queue.clone()
    return {**({"algo_state_dict": exported} if chosen is ATC else exported), "method": pretrained.method}


def write_state_dict(state: dict[str, Any], path: str | Path) -> Path:
    """Write state dicts with ``torch.save``, whole or not at all; ``torch.load(path, weights_only=True)`` reads them.

    Args:
        state: of :func:`export_state_dict`.
        path: file to write or replace.

    Returns:
        ``path``.

    Raises:
        PretrainedError: ``path`` is a directory.
        DiskSpaceError: if the disk is full; a file there is kept.
    """
    path = Path(path)
    if path.is_dir():
        raise PretrainedError(f"{path} is a directory; name a file in it, such as {path / 'state.pt'}.")
    content = io.BytesIO()
    torch.save(state, content)  # not into the file: torch hides what the system says of it
    return write_whole(path, content.getvalue())


def _state_of(pretrained: Pretrained, role: str) -> dict[str, Tensor]:
    module = getattr(pretrained, role, None)
    if module is not None:
        return module.state_dict()
    prefix = f"{role}_params."
    return {k.removeprefix(prefix): v for k, v in pretrained.rest.items() if k.startswith(prefix)}


def _write(
    sections: dict[str, dict[str, Tensor]], section: str, head: Head, state: dict[str, Tensor]
) -> None:
    table = sections.setdefault(section, {})
    for ours, theirs in head.layers.items():
        for name in ("weight", "bias"):
            if join(ours, name) in state:
                table[join(theirs, name)] = state[join(ours, name)].detach().clone()


def _require_fit(pretrained: Pretrained, layout: Layout) -> None:
    wrong = []
    config = pretrained.encoder.config
    pixels = {"image_size": IMAGE_SIZE, "pixel_scale": 1 / 255, "pixel_offset": layout.pixel_offset}
    for name, theirs in pixels.items():
        if abs(config[name] - theirs) > 1e-9:
            wrong.append(f"{name} is {config[name]}, theirs {theirs}")
    strides = tuple(config["strides"])
    if layout is not ATC and strides != _SHARED_STRIDES:
        wrong.append(f"the strides are {strides}, theirs {_SHARED_STRIDES}")
    for role, head in layout.heads.items():
        state = _state_of(pretrained, role)
        if any(join(layer, "weight") not in state for layer in head.layers):
            wrong.append(f"there is no {role} like theirs")
    if wrong:
        raise PretrainedError(
            f"The pretrained encoder ({pretrained.method}) does not fit {layout.source}: {'; '.join(wrong)}."
        )
