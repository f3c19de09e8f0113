"""Options of any settable Gymnasium env in processes, as a macro environment."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal

import gymnasium

from torchrl_hmcts.checks import real_number, whole_number
from torchrl_hmcts.envs.gym.features import Features
from torchrl_hmcts.envs.gym.option_run import GymRun, OptionWorker
from torchrl_hmcts.envs.gym.process_pool import ProcessPool
from torchrl_hmcts.envs.gym.snapshots import DEFAULT_CAP


class OptionPool(ProcessPool):
    r"""Options of a Gymnasium env, taken by a worker in a plain loop inside processes.

    The action is an option. A step takes each state of the batch to the end of its option: the
    worker acts until ``max_steps``, its own ``ends``, or the end of the episode. With
    :math:`r_{i+1}` the env's rewards and :math:`k` the steps taken, it writes

    .. math:: \text{reward} = \sum_{i<k} \gamma^i r_{i+1}, \qquad \text{duration} = k.

    It is stateless: the tensordict holds the state as ``"snapshot"``, as :class:`SettableGymEnv`
    writes it, and any batch can be stepped. A planner can search in it, and an agent can act in it.
    Each option is one message to a process. Choose ``leaves_per_wave`` a few times as large as
    ``num_processes``.

    An outcome is a function of the state, the option, the worker's weights and the pool's seed; so
    a search is the same with any number of processes, and a plan happens as predicted: a planner
    knows the draws of env and worker in advance. With ``determinised=False`` every call draws other
    numbers, for a planner that samples options more than once (``chance=ProgressiveWidening()``).

    If a process dies, is stopped, or hangs for ``step_seconds``, the pool starts it and its options
    again. ``num_restarts`` counts restarts; ``num_steps`` counts all base steps, lost ones
    included. The processes start with the first step. A copy of a pool has its own processes. In a
    forked process, and in one that may have no children, such as a worker of a ``DataLoader``,
    options run as with ``num_processes=0``. Threads take turns.

    Writes, besides the observation: ``"snapshot"`` (uint8 ``[*B, width]``), ``"duration"`` (int64
    ``[*B, 1]``, base steps), and ``"features"`` (``[*B, F]``) where ``features`` are given.

    Args:
        env (str or callable): an id, or a function that makes the env, called in each process.
        worker (OptionWorker): e.g. :class:`RepeatActions` or :class:`SkillWorker`. It is sent to
            each process once; weights in shared memory stay shared, so that updates are seen at
            once.
        max_steps (int): base steps after which an option ends.
        num_processes (int, optional): 0 runs the options in the calling process. Default: one for
            each core.
        gamma (float): discount per base step; the planner takes it over. Default 0.99.
        determinised (bool): see above. Default True.
        snapshot, cap: as in :class:`SettableGymEnv`.
        features (callable, optional): ``features(env, observation)`` gives an array ``[F]`` of the
            state at an option's end, e.g. a place for a novelty test that no observation has.
        still (float): an option ends early when it moves the features less than this within a fifth
            of ``max_steps``, e.g. at a wall. Default 0: never.
        start_method ("forkserver" or "spawn"): how processes are started. Default forkserver, or
            spawn where the path of the temporary folder (``TMPDIR``) is too long for it. As always
            with :mod:`multiprocessing`, a script needs ``if __name__ == "__main__":``.
        step_seconds (float): longest time for one step of the worker and the env, seconds. A
            process that neither steps nor uses the processor for so long is replaced; one that
            computes without a step, after ten times as long, at least two minutes. Default 60.
        batch_size (sequence of int): of ``reset()`` without a tensordict. Default none.
        seed (int, optional): of starts and of the draws inside options.
        **keywords: of ``gymnasium.make``.

    Raises:
        TypeError: if ``env`` is an env, which cannot be sent to processes.
        ImportError: if a package is missing; the extra that has it is named.
        ValueError: if an argument or an option is out of range, or the state cannot be stored.
        RuntimeError: when stepping, if the worker or the env raises an error, or processes die or
            hang again and again.
        OSError: if there is too little shared memory, too few descriptors, or no process can start.

    Reference:
        Sutton, Precup and Singh, "Between MDPs and semi-MDPs", 1999.

    Example:
        >>> from torchrl_hmcts.envs import OptionPool, RepeatActions
        >>> from torchrl_hmcts.planners import MCTSPlanner, SearchBudget
        >>> pool = OptionPool("CartPole-v1", RepeatActions(2), max_steps=3, num_processes=0, seed=0)
        >>> planner = MCTSPlanner(pool, budget=SearchBudget(base_steps=200, until_plan=False))
        >>> pool.rollout(4, policy=planner)["next", "duration"].flatten().tolist()
        [3, 3, 3, 3]
    """

    def __init__(
        self,
        env: str | Callable[..., gymnasium.Env],
        worker: OptionWorker,
        *,
        max_steps: int,
        num_processes: int | None = None,
        gamma: float = 0.99,
        determinised: bool = True,
        snapshot: Any = None,
        cap: int = DEFAULT_CAP,
        features: Features | None = None,
        still: float = 0.0,
        start_method: Literal["forkserver", "spawn"] = "forkserver",
        step_seconds: float = 60.0,
        batch_size: Sequence[int] = (),
        seed: int | None = None,
        **keywords: Any,
    ) -> None:
        if isinstance(env, gymnasium.Env):
            raise TypeError(
                f"OptionPool makes an env in each process, so it needs an id or a function that "
                f"makes one; got the env {env}. Pass e.g. lambda: make_it()."
            )
        if still and features is None:
            raise ValueError(
                f"OptionPool(still={still}) is a distance of features; pass features=."
            )
        run = GymRun(
            env,
            keywords,
            snapshot,
            cap,
            worker,
            whole_number("OptionPool", "max_steps", max_steps, least=1),
            real_number("OptionPool", "gamma", gamma, above=0.0, most=1.0),
            not determinised,
            features,
            real_number("OptionPool", "still", still, least=0.0),
        )
        super().__init__(
            run,
            num_processes=num_processes,
            determinised=determinised,
            start_method=start_method,
            step_seconds=step_seconds,
            batch_size=batch_size,
            seed=seed,
        )

    def __repr__(self) -> str:
        run: Any = self._run
        kind, spec = type(run.snapshot).__name__, run.env.spec
        name = spec.id if spec is not None else type(run.env.unwrapped).__name__
        return f"OptionPool({name}, {self.worker!r}, snapshot={kind})"
