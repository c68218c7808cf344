"""Snapshots of the original repositories, turned into our artifact without running anything in them."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Literal

from crptpro.errors import PretrainedError
from crptpro.pretrained.importing.convert import to_pretrained
from crptpro.pretrained.importing.layouts import recognise
from crptpro.pretrained.importing.names import LayoutFamily
from crptpro.pretrained.importing.torch_file import TorchFile
from crptpro.pretrained.saving import refuse_foreign, save_pretrained

_LOG = logging.getLogger(__name__)

_READABLE = (
    "Snapshots of denisyarats/proto and liuxin0824/CRPTpro (expl_agent_*.pt, task_agent_*.pt), of "
    "rll-research/url_benchmark and Rooshy-yang/BeCL (snapshot_*.pt) and of ATC (rlpyt's params.pkl) can be, and "
    "what `crptpro export` wrote."
)

__all__ = ["import_snapshot"]


def import_snapshot(
    path: str | Path, out: str | Path, *, layout: Literal["auto"] | LayoutFamily = "auto"
) -> Path:
    """Turn a snapshot of an original repository into an artifact.

    The repository need not be installed, and nothing in the file is imported or executed: its pickles are read
    as plain data. The card says under ``imported`` where the networks are from, which were found and which left
    behind (actors and critics always are), and the settings beside them; under ``pixels``, how the encoder
    wants its pixels scaled. Sizes follow from the tensors; the images are 84 x 84 in all these repositories.

    ======  ==================================================================  ===========================
    layout  file                                                                method of the artifact
    ======  ==================================================================  ===========================
    proto   whole pickled agent of denisyarats/proto or liuxin0824/CRPTpro      proto-rl-s or released-code
    urlb    ``{agent, _global_step, _global_episode}`` of BeCL or of URLB       becl; proto-rl-s for URLB's
                                                                                proto; urlb-<agent> (encoder
                                                                                only) for the others
    atc     ``{itr, algo_state_dict: {encoder, target_encoder, contrast}}``     atc or atc-native
    ======  ==================================================================  ===========================

    Args:
        path: the file, in torch's zip format or the one before torch 1.6.
        out: directory to write; an artifact there is replaced.
        layout: what the file must be; ``"auto"`` takes any.

    Returns:
        ``out``.

    Raises:
        PretrainedError: the file is anything else, damaged, or does not fit this library's networks; or ``out``
            is another kind of directory. Nothing is written then.
    """
    path, out = Path(path), Path(out)
    refuse_foreign(out)
    try:
        with open(path, "rb") as file:
            snapshot = TorchFile(file)
            contents = recognise(snapshot.root)
            if layout not in ("auto", contents.layout.family):
                raise PretrainedError(f"its layout is {contents.layout.family!r}, not {layout!r}.")
            pretrained = to_pretrained(contents, snapshot)
            pretrained.card["imported"]["file"] = path.name
    except (PretrainedError, OSError) as reason:
        told = f"{reason.strerror}." if isinstance(reason, OSError) else reason
        raise PretrainedError(f"{path} cannot be imported: {told} {_READABLE}") from None
    facts = pretrained.card["imported"]
    _LOG.info("%s (%s): %s", path.name, facts["source"], ", ".join(facts["networks"]))
    if facts["left"]:
        _LOG.info("left behind: %s", ", ".join(facts["left"]))
    return save_pretrained(pretrained, out)
