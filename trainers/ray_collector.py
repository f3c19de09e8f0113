"""A collector whose env runs in a process of a Ray cluster, on this machine or another."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from typing import Any

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import Collector
from torchrl.envs import EnvBase

from torchrl_hmcts.trainers.restarting_collector import RestartingCollector


def make_ray_collector(
    env: EnvBase,
    policy: TensorDictModuleBase,
    *,
    frames_per_batch: int,
    total_frames: int,
    postproc: Callable[[TensorDictBase], TensorDictBase] | None = None,
    num_collectors: int = 1,
    num_cpus: int | None = None,
    **collector_kwargs: Any,
) -> Any:
    """Build TorchRL's ``RayCollector``, for the ``make_collector`` of ``DIAYNTrainer``.

    Joins the cluster that the variable ``RAY_ADDRESS`` names, or the one of this machine; where
    there is none, one is started in this process and ended with the collector. The env is sent to
    the cluster as it is, each batch comes back, and the policy's weights go there after it. A
    process that dies is started again, see :class:`RestartingCollector`.

    Args:
        env: that is sent; it must be picklable.
        policy: acts there with a copy of the weights.
        frames_per_batch: steps of a batch, all collectors together.
        total_frames: steps in all.
        postproc: applied to every batch here. Default: none.
        num_collectors: processes that collect. Default 1.
        num_cpus: cores of a cluster that is started here. Default: one per collector.
        **collector_kwargs: of the ``Collector`` in each process.

    Returns:
        RestartingCollector: with the weights in place.

    Raises:
        ModuleNotFoundError: if ray is not installed.
    """
    import ray
    from torchrl.collectors.distributed import RayCollector

    trust_policy = bool(collector_kwargs.pop("trust_policy", True))
    if not ray.is_initialized():
        address = os.environ.get("RAY_ADDRESS")
        own: dict[str, Any] = {"num_cpus": num_cpus or num_collectors, "include_dashboard": False}
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
