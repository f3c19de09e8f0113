"""Loggers of a training while it runs: CSV files always, others on request."""

from __future__ import annotations

import contextlib
import importlib
import math
import os
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextvars import ContextVar
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from torch import Tensor
from torchrl.record.loggers import CSVLogger, Logger

from torchrl_hmcts.trainers.saving.files import left_out

Observer = Callable[[str, float, int], None]
_OBSERVERS: ContextVar[tuple[Observer, ...]] = ContextVar("observers", default=())


class ScalarLoggers(Logger):
    """Hands every value to several loggers, and to those who observe the run.

    A logger that fails, e.g. on a full disk, is left out from there on, and a line says so.
    """

    def __init__(self, loggers: Sequence[Logger], observers: Sequence[Observer] = ()) -> None:
        self.loggers, self.observers = list(loggers), list(observers)
        super().__init__(exp_name="log", log_dir=None)

    def _create_experiment(self) -> None:
        return None

    def log_scalar(self, name: str, value: float, step: int | None = None) -> None:
        """Log a value; what is not finite is left out."""
        if not math.isfinite(value):
            return
        self._each(lambda logger: logger.log_scalar(_grouped(logger, name), float(value), step))
        for observer in self.observers:
            observer(name, float(value), -1 if step is None else step)

    def log_video(self, name: str, video: Tensor, step: int | None = None, **kwargs: Any) -> None:
        """Log a video where that is possible."""
        self._each(lambda logger: logger.log_video(name, video, step=step, **kwargs))

    def log_pictures(self, folder: Path, captions: Mapping[str, str]) -> None:
        """Log the pictures and films of a run's page where that is possible."""
        for name, caption in captions.items():
            path = folder / name
            if path.is_file():
                self._each(partial(_picture, path=path, caption=caption))

    def log_hparams(self, cfg: Mapping[str, Any]) -> None:
        """Log the configuration."""
        self._each(lambda logger: logger.log_hparams(dict(cfg)))

    def log_histogram(self, name: str, data: Sequence[float], **kwargs: Any) -> None:
        """Log a histogram where that is possible."""

        def log(logger: Logger) -> None:
            with contextlib.suppress(NotImplementedError):
                logger.log_histogram(name, data, **kwargs)

        self._each(log)

    def state_dict(self) -> dict[str, Any]:
        """Return nothing: a run that is continued appends to its files."""
        return {}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Take nothing."""

    def close(self) -> None:
        """Write what is still to be written, and close the files."""
        self._each(_close)

    def _each(self, act: Callable[[Logger], None]) -> None:
        """Do something with every logger; one that fails, e.g. on a full disk, gets no more."""
        for logger in list(self.loggers):
            with left_out(f"what {type(logger).__name__} still had to log") as missing:
                act(logger)
            if missing:
                self.loggers.remove(logger)
                with contextlib.suppress(Exception):  # what it could not write, it cannot now
                    _close(logger)

    def __repr__(self) -> str:
        return f"ScalarLoggers({self.loggers})"


def _grouped(logger: Logger, name: str) -> str:
    """The name of a value: in a group where a page shows groups; files keep the plain name."""
    if isinstance(logger, CSVLogger) or "/" in name:
        return name
    if name.startswith(("eval_", "test_")):
        return f"eval/{name.partition('_')[2]}"
    words = name.split("_")
    return f"{'loss' if 'loss' in words else 'train'}/{name}"


def _picture(logger: Logger, path: Path, caption: str) -> None:
    tag, experiment = f"pictures/{path.stem}", logger.experiment
    if type(logger).__name__ == "WandbLogger":
        import wandb

        film = path.suffix == ".gif"
        kind = wandb.Video(str(path), format="gif") if film else wandb.Image(str(path))
        experiment.log({tag: kind})
    elif type(logger).__name__ == "TensorboardLogger":
        from tensorboard.compat.proto.summary_pb2 import Summary

        # Its page shows all that a browser does, films included; the bytes go in as they are.
        image = Summary.Image(colorspace=3, encoded_image_string=path.read_bytes())
        value = Summary.Value(tag=tag, image=image)
        experiment.file_writer.add_summary(Summary(value=[value]), 0)


def _close(logger: Logger) -> None:
    experiment = logger.experiment
    for file in getattr(experiment, "files", {}).values():
        file.close()
    for name in ("finish", "close"):  # of Weights & Biases; of TensorBoard
        end = getattr(experiment, name, None)
        if callable(end):
            end()
            break


def make_logger(config: Any) -> ScalarLoggers:
    """Build the loggers of an experiment; files of an older run in the folder are removed."""
    out = Path(config.out)
    out.mkdir(parents=True, exist_ok=True)
    if not config.resume:
        for old in ("log", "tensorboard"):
            shutil.rmtree(out / old, ignore_errors=True)
    loggers: list[Logger] = [CSVLogger(exp_name="log", log_dir=str(out))]
    if config.logger != "csv":
        importlib.import_module(config.logger)
    if config.logger == "tensorboard":
        from torchrl.record.loggers import TensorboardLogger

        loggers.append(TensorboardLogger(exp_name="tensorboard", log_dir=str(out)))
    elif config.logger == "wandb":
        from torchrl.record.loggers import WandbLogger

        offline = os.environ.get("WANDB_MODE", "offline") != "online"
        loggers.append(WandbLogger(exp_name=out.name, offline=offline, save_dir=str(out)))
    made = ScalarLoggers(loggers, _OBSERVERS.get())
    keys = {**asdict(config), "out": out.name}  # TensorBoard takes no dicts
    made.log_hparams({k: str(v) if isinstance(v, dict) else v for k, v in keys.items()})
    return made


@contextlib.contextmanager
def observed(observer: Observer) -> Iterator[None]:
    """Tell an observer every value that experiments log in the context."""
    token = _OBSERVERS.set((*_OBSERVERS.get(), observer))
    try:
        yield
    finally:
        _OBSERVERS.reset(token)
