"""The pre-training loop: over domains, logged, checkpointed, resumable at any moment."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from torchrl.objectives import LossModule

from crptpro.directory_lock import DirectoryLock
from crptpro.errors import CheckpointError
from crptpro.loggers import RunLogger
from crptpro.modules import (
    computing,
    resolve_channels_last,
    resolve_precision,
    usable_device,
)
from crptpro.modules.precision import Precision
from crptpro.objectives import method_defaults
from crptpro.seeding import derive_seed, kept_global_rng
from crptpro.switches import Switch
from crptpro.training.captured import resolve_cuda_graph
from crptpro.training.compiled import Compiled, resolve_compile
from crptpro.training.fingerprint import precision_to_continue
from crptpro.training.pretrain.augmenter import Augment, Augmenter
from crptpro.training.pretrain.device_batches import DeviceBatches
from crptpro.training.pretrain.learner import Learner, has_targets
from crptpro.training.pretrain.moments import read_moments
from crptpro.training.pretrain.result import PretrainResult
from crptpro.training.pretrain.run import PretrainRun, read_state
from crptpro.training.pretrain.sources import (
    SHIFT_PAD,
    Source,
    keys_read,
    open_sources,
    views_read,
)
from crptpro.training.pretrain.turns import DomainSchedule, Turns, require_schedule


def pretrain(
    loss: LossModule,
    datasets: Any,
    *,
    updates: int | None = None,
    batch_size: int | None = None,
    learning_rate: float | None = None,
    warmup_updates: int | None = None,
    encoder_tau: float | None = None,
    domain_schedule: DomainSchedule = "cycle",
    seed: int = 0,
    augment: Augment = "random_shift",
    precision: Precision = "auto",
    channels_last: Switch = "auto",
    compile: Switch = "auto",
    cuda_graph: Switch = "auto",
    device: str | torch.device = "cpu",
    run_dir: str | Path | None = None,
    logger: RunLogger | None = None,
    log_interval: int = 100,
    checkpoint_interval: int | None = None,
    resume: bool = True,
    patience_updates: int = 5_000,
    at_updates: Mapping[int, Callable[[LossModule], Any]] | None = None,
    optimizer_state_from: str | Path | None = None,
    progress: bool = True,
) -> PretrainResult:
    """Train a self-supervised loss on the datasets of several domains (CRPTpro, Sec. III; algorithm 1).

    Update u (from 0) uses dataset u mod N only, unless ``domain_schedule`` says otherwise: one batch, one Adam step,
    one EMA step of the targets. Any ``LossModule`` works that returns scalar ``loss_*`` terms for a batch with the
    entries of its ``in_keys`` (``pixels`` and ``("next", "pixels")`` in every dataset); a method
    ``before_update()``, if it has one, is called before each forward. The loss is trained in place; its
    ``training_record`` afterwards says how, for the artifact's card.

    With ``run_dir`` the run can be killed at any moment: the same call with a newly built loss continues from
    the last checkpoint and, on the CPU with the same number of threads, gives the same weights as an
    uninterrupted one. A larger ``updates`` extends a finished run. Ctrl-C and SIGTERM write a checkpoint,
    then end the program.

    Args:
        loss: the objective with its networks.
        datasets: one or several (sequence, or mapping of domain names): directories,
            :class:`~crptpro.data.FrameDataset`, or any TorchRL ``ReplayBuffer`` whose samples have the
            loss's keys.
        updates: encoder updates in total over all domains; the method's default is 50,000.
        batch_size: transitions per update; default 512.
        learning_rate: of Adam; default 1e-4.
        warmup_updates: updates over which the learning rate rises linearly from 0, before the method's schedule;
            default 0 (ATC 1,000).
        encoder_tau: EMA rate of the target networks; default 0.05.
        domain_schedule: whose rows an update takes: ``"cycle"``: update u those of dataset u mod N; ``"random"``:
            those of a dataset drawn uniformly for each update; ``"mixed"``: of every dataset, ``batch_size`` split as
            evenly as possible (the first datasets get the remainder) and each part augmented by itself. The record
            has no columns per domain then, the collapse is judged over the whole batch, and a GPU makes batches
            without its fast way. Deviation: the paper takes one domain after the other, which ``"cycle"`` gives.
        seed: seeds sampling, shifts, and what the loss draws; the global generators (torch, NumPy,
            Python) are left as they were.
        augment: ``"random_shift"`` (4 pixels, replicated border; independent per image and per sample),
            ``"none"``, or a function of a batch and a generator. Entries that the loss names in ``views`` are
            the same images, shifted once more (copies for ``"none"`` and a function).
        precision: ``"fp32"``, ``"bf16"`` or ``"auto"`` (bf16 where the hardware is faster in it; a run
            that is continued keeps what it began with).
            Deviation: the released code computes in fp32 throughout, which ``"fp32"`` gives.
        channels_last: ``"on"``, ``"off"`` or ``"auto"`` (on): the memory layout of the convolutions. Changes rounding
            only.
        compile: ``"on"``, ``"off"`` or ``"auto"`` (off): compile the loss with ``torch.compile``. Changes
            rounding only. On a CPU the convolutions stay as they are.
        cuda_graph: ``"on"``, ``"off"`` or ``"auto"`` (off): on a GPU, record the whole update and replay it. An
            own loss must not read values back to the host (``.item()``) then.
        device: where to train. Directories are then opened on it: a GPU holds a copy of the frames, and
            batches are drawn and shifted there.
        run_dir: record (``pretrain.csv``, ``metrics.jsonl``) and checkpoints; ``None`` writes nothing.
        logger: used instead of a local record in ``run_dir``, e.g. one that mirrors to W&B.
        log_interval: updates between two rows; each holds means over the updates since the last.
        checkpoint_interval: updates between two checkpoints; ``None``: about every five minutes. The end of
            the run is always one.
        resume: continue what ``run_dir`` holds; ``False`` refuses a directory that holds a run.
        patience_updates: length of a plateau after which the run is called dead.
        at_updates: what to call with the loss when so many updates are done, as
            :func:`crptpro.pretrained.encoder_snapshots` gives it to keep the encoder at several points of one run. It
            must leave the loss as it is. A run that was killed calls it again if it does that update again, and an
            earlier call's updates are not done again.
        optimizer_state_from: run directory of an earlier pre-training that left the loss's weights; a fresh start
            goes on with Adam's moments from its newest checkpoint, at this run's learning rate. It is read again
            when the run is continued, which then has its own. ``None``: a fresh Adam.
        progress: show a bar (never in log files).

    Returns:
        Final metrics, the verdict on collapse, and the logged rows.

    Raises:
        CheckpointError: if ``run_dir`` holds a run with other settings (named), all its checkpoints are
            damaged, or another process is running in it; if ``optimizer_state_from`` has no checkpoint of a
            pre-training, or one of other parameters or weights.
        NonFiniteError: naming update, domain and term; the last checkpoint is kept.
        DatasetError: if a dataset is unusable, shows other images than the encoder takes, or lacks an entry
            that the loss reads.
        ValueError: naming an impossible setting, as fewer rows in a mixed batch than there are domains.
        CRPTproError: if the device cannot be used.
        CompileError: if compiling is asked for and fails, or an update cannot be recorded.
        DiskSpaceError: if the disk cannot hold the checkpoints.
    """
    defaults = method_defaults(loss)
    settings: dict[str, Any] = {
        "updates": defaults.updates if updates is None else updates,
        "batch_size": defaults.batch_size if batch_size is None else batch_size,
        "log_interval": log_interval,
        "checkpoint_interval": checkpoint_interval,
    }
    for name, value in settings.items():
        if value is not None and value < 1:
            raise ValueError(f"`{name}` must be at least 1, got {value}.")
    for done in at_updates or ():
        if not 1 <= done <= settings["updates"]:
            raise ValueError(
                f"`at_updates` must lie in 1 to `updates`, here {settings['updates']}, got {done}."
            )
    if warmup_updates is not None:
        if warmup_updates < 0:
            raise ValueError(f"`warmup_updates` must not be negative, got {warmup_updates}.")
        defaults = dataclasses.replace(defaults, warmup_updates=warmup_updates)
    if learning_rate is not None and not learning_rate > 0:
        raise ValueError(f"`learning_rate` must be positive, got {learning_rate}.")
    if encoder_tau is not None and not 0 <= encoder_tau <= 1:
        raise ValueError(f"`encoder_tau` must be in [0, 1], got {encoder_tau}.")
    if encoder_tau is not None and not has_targets(loss):
        raise ValueError(
            f"`encoder_tau` {encoder_tau} is the rate of target networks, which {type(loss).__name__} does not have; "
            "leave it out."
        )
    device = usable_device(device)
    puts_channels_last = resolve_channels_last(channels_last)
    compiled = Compiled(is_on=resolve_compile(compile))
    captures = resolve_cuda_graph(cuda_graph, device)
    loss.to(device).train()
    with contextlib.ExitStack() as stack:
        stack.enter_context(kept_global_rng())
        torch.manual_seed(derive_seed(seed, "pretrain", "loss"))
        sources = open_sources(datasets, seed=seed, device=device)
        for source in sources:
            source.require_fit(getattr(loss, "encoder", None))
        require_schedule(domain_schedule, batch_size=settings["batch_size"], num_domains=len(sources))
        moments = None if optimizer_state_from is None else read_moments(optimizer_state_from, loss)
        if run_dir is not None:
            stack.enter_context(DirectoryLock(run_dir, error=CheckpointError, is_reentrant=True))
            logger = logger or stack.enter_context(RunLogger(run_dir))
        state = None if run_dir is None else read_state(run_dir, resume=resume)
        dtype = resolve_precision(precision_to_continue(precision, state), device)
        stack.enter_context(computing(loss, dtype, channels_last=puts_channels_last))
        batches = None
        if domain_schedule != "mixed":
            batches = _device_batches(
                loss, sources, augment, settings["batch_size"], seed, compiled=compiled, captures=captures
            )
        run = PretrainRun(
            loss,
            Turns(
                domain_schedule,
                sources,
                Augmenter(augment, seed=seed, views=views_read(loss)),
                batches=batches,
                keys=keys_read(loss),
                batch_size=settings["batch_size"],
                seed=seed,
                device=device,
            ),
            learner=Learner(
                loss,
                defaults,
                learning_rate=defaults.lr if learning_rate is None else learning_rate,
                encoder_tau=defaults.encoder_tau if encoder_tau is None else encoder_tau,
                updates=settings["updates"],
                compiled=compiled,
                captures=captures,
                inputs=None if batches is None else batches.batch,
                moments=moments,
            ),
            settings={**settings, "seed": seed, "patience_updates": patience_updates},
            device=device,
            precision="bf16" if dtype == torch.bfloat16 else "fp32",
            logger=logger,
            run_dir=None if run_dir is None else Path(run_dir),
            at_updates=at_updates,
        )
        run.prepare(state)
        return run.train(progress=progress)


def _device_batches(
    loss: LossModule,
    sources: list[Source],
    augment: Augment,
    batch_size: int,
    seed: int,
    *,
    compiled: Compiled,
    captures: bool,
) -> DeviceBatches | None:
    """Batches made on the GPU that holds the frames, or None where they are made on the CPU."""
    datasets = {source.name: source.dataset for source in sources}
    keys, views = keys_read(loss), getattr(loss, "views", {})
    if augment not in ("random_shift", "none") or not DeviceBatches.fits(datasets, keys, views):
        return None
    if keys is None or not _is_gpu(sources[0].dataset.frames.get("pixels").device):
        return None
    return DeviceBatches(
        datasets,
        batch_size=batch_size,
        keys=keys,
        views=views,
        pad=SHIFT_PAD if augment == "random_shift" else 0,
        seed=seed,
        compiled=compiled,
        captures=captures,
    )


def _is_gpu(device: torch.device) -> bool:
    return device.type != "cpu"
