"""Collectors whose processes may die and are started again, here and in a Ray cluster."""

from __future__ import annotations

import contextlib
import logging
import os
import sys
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import Collector
from torchrl.envs import EnvBase

_ASKED = ("update_policy_weights_", "state_dict", "load_state_dict")  # of the processes
_MAX_DEATHS = 3  # with no batch between them that are borne


class CollectorError(RuntimeError):
    """Processes that collect died again and again.

    Examples:
        >>> from torchrl_hmcts.trainers import CollectorError
        >>> issubclass(CollectorError, RuntimeError)
        True
    """


class LocalCollector:
    """A collector in this process whose policy is the network that is trained."""

    init_random_frames = 0

    def shutdown(self, *args: Any, **kwargs: Any) -> None:
        """Do nothing: no other process runs."""

    def update_policy_weights_(self, *args: Any, **kwargs: Any) -> None:
        """Do nothing: the weights are the same tensors."""


class RestartingCollector:
    """Builds its collector again when a process of it dies, and continues.

    The batch that was under way is lost, and the episodes: new ones begin. All other attributes are
    those of the collector it has built last; ``num_restarts`` counts those after the first.
    """

    def __init__(
        self,
        make: Callable[[int, int], Any],
        died: Callable[[Any, Exception], bool],
        total_frames: int,
    ) -> None:
        self._make, self._died = make, died
        self.total_frames = total_frames
        self.collected_frames = self.num_restarts = 0
        self._deaths = 0
        self._collector = make(total_frames, 0)

    def __getattr__(self, name: str) -> Any:
        if name == "_collector":  # not built yet
            raise AttributeError(name)
        return partial(self._ask, name) if name in _ASKED else getattr(self._collector, name)

    def __iter__(self) -> Iterator[TensorDictBase]:
        while self.collected_frames < self.total_frames:
            collector = self._collector
            try:
                for batch in collector:
                    self._deaths = 0
                    self.collected_frames += batch.numel()
                    yield batch
                    if self._collector is not collector:  # it died outside of this loop
                        break
                else:
                    return
            except Exception as error:
                self._restart(error)

    def _ask(self, method: str, *args: Any, **kwargs: Any) -> Any:
        while True:
            try:
                return getattr(self._collector, method)(*args, **kwargs)
            except Exception as error:
                self._restart(error)

    def _restart(self, error: Exception) -> None:
        while True:
            if not self._died(self._collector, error):
                raise error
            self._deaths += 1
            with contextlib.suppress(Exception):  # what is left of it
                self._collector.shutdown()
            cause = f"{type(error).__name__}: {(str(error).splitlines() or [''])[0]}".rstrip(": ")
            what = f"A process that collects died ({cause})"
            if self._deaths > _MAX_DEATHS:
                raise CollectorError(
                    f"{what}, {self._deaths} times without a batch between them, after "
                    f"{self.collected_frames} base steps. Look for what ends it: too little "
                    "memory, or an env that crashes; collector=local runs it in this process."
                ) from error
            print(f"{what}; it is started again.", file=sys.stderr)
            self.num_restarts += 1
            left = self.total_frames - self.collected_frames
            try:
                self._collector = self._make(left, self.num_restarts)
                return
            except Exception as again:
                error = again


def make_ray_collector(
    env: EnvBase,
    policy: TensorDictModuleBase,
    *,
    frames_per_batch: int,
    total_frames: int,
    postproc: Callable[[TensorDictBase], TensorDictBase] | None = None,
    num_collectors: int = 1,
    **collector_kwargs: Any,
) -> RestartingCollector:
    """Build TorchRL's ``RayCollector``, for the ``make_collector`` of ``DIAYNTrainer``.

    Joins the cluster that the variable ``RAY_ADDRESS`` names, or the one of this machine; where
    there is none, one is started in this process and ended with the collector. The env is sent to
    the cluster as it is, each batch comes back, and the policy's weights go there after it. A
    process that dies is started again, see :class:`RestartingCollector`.
    """
    import ray
    from torchrl.collectors.distributed import RayCollector

    trust_policy = bool(collector_kwargs.pop("trust_policy", True))
    if not ray.is_initialized():
        address = os.environ.get("RAY_ADDRESS")
        own: dict[str, Any] = {"num_cpus": num_collectors, "include_dashboard": False}
        ray.init(
            address=address,
            ignore_reinit_error=True,
            log_to_driver=False,
            logging_level=logging.WARNING,
            **({} if address else own),
        )

    def make(frames: int, deaths: int) -> Any:
        if deaths:  # other starts than those of the process that died
            env.set_seed(deaths)
        collector = RayCollector(
            [lambda: env] * num_collectors,
            policy,
            collector_class=Collector,
            num_collectors=num_collectors,
            frames_per_batch=frames_per_batch,
            total_frames=frames,
            sync=True,
            trust_policy=trust_policy,
            collector_kwargs=dict(collector_kwargs),
            remote_configs={"num_cpus": 1},
            postproc=postproc,
        )
        # The weights' way there is opened before the first batch, within a minute: wait until the
        # processes have imported all they need.
        ray.get(_greet(collector))
        collector.update_policy_weights_()
        return collector

    return RestartingCollector(make, _died, total_frames)


def _greet(collector: Any) -> list[Any]:
    return [remote.print_remote_collector_info.remote() for remote in collector.remote_collectors]


def _died(collector: Any, error: Exception) -> bool:
    """Whether a process of the cluster died, as ray says or as the weights' way there shows."""
    from ray import exceptions, get

    if isinstance(error, exceptions.RayTaskError):  # it lives, and raised an error
        return False
    if isinstance(error, exceptions.RayError):
        return isinstance(
            error,
            exceptions.RayActorError
            | exceptions.WorkerCrashedError
            | exceptions.NodeDiedError
            | exceptions.ObjectLostError
            | exceptions.OutOfMemoryError,
        )
    if not isinstance(error, RuntimeError):
        return False
    try:
        get(_greet(collector), timeout=30)
    except exceptions.GetTimeoutError:
        return False
    except exceptions.RayError:
        return True
    return False
