"""Logging of runs: a local record that is always written, mirrored to W&B and TensorBoard on request."""

from crptpro.loggers.mirrors import WandbOptions
from crptpro.loggers.run_logger import RunLogger

__all__ = ["RunLogger", "WandbOptions"]
