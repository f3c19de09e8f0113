"""Checks of environments: specs, resets, states, workers.

Letters: *B batch of a tensordict, T steps of a rollout, m states stepped at once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey, expand_as_right, unravel_key
from torchrl.data import Categorical, OneHot
from torchrl.envs import EnvBase, ParallelEnv, SerialEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs

from torchrl_hmcts.carried_state import ForeignStates
from torchrl_hmcts.nesting import env_name, flat_transforms
from torchrl_hmcts.planners.simulator import Simulator
from torchrl_hmcts.testing.contract import (
    during,
    leaves,
    require,
    require_same,
    seeded,
)

Policy = Callable[[TensorDictBase], TensorDictBase]


def check_env(
    env: EnvBase,
    *,
    num_steps: int = 8,
    seed: int = 0,
    seeds_repeat: bool = True,
    mask_key: NestedKey = "action_mask",
    redrawn_keys: Sequence[NestedKey] = (),
) -> None:
    """Check that an env keeps TorchRL's contract: specs, seeds, episodes, partial resets and steps.

    TorchRL's ``check_env_specs``, with episodes that continue after their end; the same seed gives
    the same rollout; the next step begins where the last one ended, or in a new episode; elements
    that are not to be reset or stepped stay as they are, and the others do not depend on them.

    Args:
        env (EnvBase): any env. Stateless ones (``batch_locked=False``) are tried in batches too.
        num_steps (int): steps of the random rollouts. Default 8; enough to reach the end of an
            episode is better.
        seed (int): of the rollouts. Default 0. The env keeps it.
        seeds_repeat (bool): whether the env is to repeat itself with its seed. Default ``True``.
        mask_key (NestedKey): actions that may be taken, bool ``[*B, A]``; if the env has it, the
            rollouts keep to it. Default ``"action_mask"``.
        redrawn_keys (sequence of NestedKey): entries that may change between a step and the next
            root, e.g. the ``"skill"`` of a ``SkillTransform``. Default none.

    Examples:
        >>> from torchrl_hmcts.testing import ChainEnv, check_env
        >>> check_env(ChainEnv(length=4))
    """
    name = _name(env)
    with during(name, "TorchRL's check_env_specs", "Correct the specs, or what is written."):
        with seeded(seed):
            env.set_seed(seed)
            check_env_specs(env, break_when_any_done="both")
    act = _random(env, mask_key)
    data = rollout(env, num_steps, seed, act)
    if seeds_repeat:
        require_same(
            data,
            rollout(env, num_steps, seed, act),
            f"{name}: two rollouts with seed {seed} differ in <key>. Draw every random number from "
            "a generator that _set_seed seeds.",
        )
    _check_continuity(env, data, {unravel_key(key) for key in redrawn_keys})
    if env.batch_size or not env.batch_locked:
        _check_partial_resets(env, seed, act)
        _check_partial_steps(env, seed, act)


def check_macro_env(
    env: EnvBase,
    *,
    num_steps: int = 8,
    seed: int = 0,
    deterministic: bool = True,
    duration_key: NestedKey = "duration",
    mask_key: NestedKey = "action_mask",
    redrawn_keys: Sequence[NestedKey] = (),
    tolerance: float = 0.0,
) -> None:
    """Check that a planner can search an env, and that its state is all that a step depends on.

    All of :func:`check_env`, and: the action is one discrete option; a step takes at least one base
    step; some option may be taken wherever an episode continues; set to the states of a rollout and
    stepped with its options the env gives what the unbroken rollout gave; a step leaves its input
    as it was; transforms of your own keep no tensor that changes from step to step. With
    ``step_async``, ``step_wait`` and ``step_abandon``: steps under way do not touch each other.

    Args:
        env (EnvBase): stateless, or with ``_supports_set_state = True``; e.g. any env under an
            :class:`~torchrl_hmcts.transforms.OptionTransform`.
        num_steps (int): steps of the rollouts. Default 8.
        seed (int): of the rollouts. Default 0. The env keeps it.
        deterministic (bool): whether a state and an option decide the outcome. Default ``True``;
            pass ``False`` for an env or a worker that draws random numbers.
        duration_key (NestedKey): base steps of a step, int64 ``[*B, 1]``; looked at if the env has
            it. Default ``"duration"``.
        mask_key (NestedKey): options that may be taken, bool ``[*B, A]``; looked at if the env has
            it. Default ``"action_mask"``.
        redrawn_keys (sequence of NestedKey): as in :func:`check_env`.
        tolerance (float): difference that is allowed, relative and absolute, e.g. 1e-6 where a
            network runs on batches of several sizes. Default 0.

    Raises:
        ContractError: if it is not.

    Examples:
        >>> from torchrl_hmcts.testing import ChainEnv, check_macro_env
        >>> check_macro_env(ChainEnv(length=4))
    """
    name = _name(env)
    with during(name, "as the simulator of a planner"):
        simulator = Simulator(env, duration_key=duration_key, mask_key=mask_key)
    foreign = ForeignStates(env)
    before = foreign.read()
    rollout(env, num_steps, seed, _random(env, mask_key))
    changed = foreign.changed(before)
    require(
        changed is None,
        f"{name}: {changed} changes as the env is stepped. A planner cannot set it: keep that "
        "state in the tensordict, and declare it in the state and observation specs.",
    )
    check_env(
        env,
        num_steps=num_steps,
        seed=seed,
        seeds_repeat=deterministic,
        mask_key=mask_key,
        redrawn_keys=redrawn_keys,
    )
    data = rollout(env, num_steps, seed, _random(env, mask_key))
    after = data.get("next")
    if simulator.duration_key is not None:
        duration, shape = after.get(simulator.duration_key), (*data.batch_size, 1)
        require(
            duration.dtype == torch.int64 and duration.shape == torch.Size(shape),
            f"{name}: the duration under {duration_key!r} is {duration.dtype} "
            f"{list(duration.shape)}; it must be int64 {list(shape)}, one number per step.",
        )
        require(
            (duration >= 1).all(),
            f"{name}: a step took {int(duration.min())} base steps ({duration_key!r}). Each takes "
            "at least one, or a search could loop without any discount.",
        )
    if simulator.mask_key is not None:
        stuck = ~after.get(simulator.mask_key).any(-1)
        require(
            not (stuck & ~after.get(env.done_keys[0]).squeeze(-1)).any(),
            f"{name}: {mask_key!r} allows no option in a state that is not done. Mark the state as "
            "terminated, or allow an option there.",
        )
    _check_set_state(env, simulator, data, deterministic, tolerance)
    if simulator.works_beside and deterministic:
        _check_beside(env, simulator, data, tolerance)


def check_parallel_env(
    make_env: Callable[[], EnvBase],
    *,
    start_methods: Sequence[str] = ("fork", "spawn"),
    num_workers: int = 2,
    num_steps: int = 4,
    seed: int = 0,
) -> None:
    """Check that an env does the same in the processes of a ``ParallelEnv`` as in this one.

    For every start method: specs hold, and rollouts with the same seed and actions are those of
    TorchRL's ``SerialEnv``.

    Args:
        make_env (callable): makes an env: a class, a function or a ``functools.partial``. (Of a
            lambda TorchRL warns.)
        start_methods (sequence of str): ``"fork"``, ``"spawn"`` or ``"forkserver"``. A spawned
            process imports everything again, which takes seconds. Default fork and spawn.
        num_workers (int): processes. Default 2.
        num_steps (int): steps of the rollouts. Default 4.
        seed (int): of the envs. Default 0.

    Raises:
        ContractError: if it does not.

    Examples:
        >>> from torchrl_hmcts.testing import ChainEnv, check_parallel_env
        >>> check_parallel_env(ChainEnv, start_methods=["fork"])
    """
    serial = SerialEnv(num_workers, make_env)
    name = _name(serial)
    try:
        with during(name, "in a SerialEnv"):
            expected = rollout(serial, num_steps, seed, _random(serial, "action_mask"))
    finally:
        serial.close(raise_if_closed=False)
    for method in start_methods:
        where = f"in a ParallelEnv of {num_workers} processes started by {method}"
        with during(name, where, "Keep nothing in the env that cannot go to another process."):
            parallel = ParallelEnv(num_workers, make_env, mp_start_method=method)
            try:
                with seeded(seed):
                    check_env_specs(parallel)
                actual = rollout(parallel, num_steps, seed, recorded(expected, parallel))
            finally:
                parallel.close(raise_if_closed=False)
        require_same(
            expected,
            actual,
            f"{name}: <key> is another {where} than in a SerialEnv, with the same seed and "
            "actions. Let _set_seed seed all that is random, and share no state between envs.",
        )


def _name(env: EnvBase) -> str:
    require(
        isinstance(env, EnvBase),
        f"{type(env).__name__} is no torchrl.envs.EnvBase. Wrap it, e.g. with GymWrapper.",
    )
    name = env_name(env)
    transforms: list[str] = []
    while isinstance(env, TransformedEnv):
        transforms[:0] = [type(part).__name__ for part in flat_transforms(env)]
        env = env.base_env
    return f"{name} under {', '.join(transforms)}" if transforms else name


def _random(env: EnvBase, mask_key: NestedKey) -> Policy:
    """Return a policy that draws actions from the spec, options from the mask if there is one."""
    action_key = env.action_keys[0]

    def act(td: TensorDictBase) -> TensorDictBase:
        td, spec = env.rand_action(td), env.full_action_spec_unbatched[action_key]
        mask = td.get(mask_key, None)
        if mask is None or not isinstance(spec, (OneHot, Categorical)):
            return td
        spec = spec.expand(*td.batch_size, *spec.shape).clone()
        spec.update_mask(mask | ~mask.any(-1, keepdim=True))
        return td.set(action_key, spec.rand())

    return act


def rollout(
    env: EnvBase, num_steps: int, seed: int = 0, policy: Policy | None = None
) -> TensorDictBase:
    """Return a rollout ``[*B, T]`` through the ends of episodes, of random actions by default."""
    with seeded(seed):
        env.set_seed(seed)
        return env.rollout(num_steps, policy, break_when_any_done=False)


def recorded(data: TensorDictBase, env: EnvBase) -> Policy:
    """Return a policy that takes the actions of a rollout ``[*B, T]`` again."""
    actions = iter(data.select(*env.action_keys).unbind(-1))
    return lambda td: td.update(next(actions))


def _ended(env: EnvBase, td: TensorDictBase) -> torch.Tensor:
    """Return in which elements an episode has ended, bool ``[*B]``."""
    done = [td.get(key).reshape(*td.batch_size, -1).any(-1) for key in env.done_keys]
    return torch.stack(done).any(0)


def _check_continuity(env: EnvBase, data: TensorDictBase, redrawn: set[NestedKey]) -> None:
    """See that what a step wrote is where the next one starts, until the end of the episode."""
    name = _name(env)
    steps = data.unbind(data.batch_dims - 1)
    roots = leaves(data.exclude("next", *env.action_keys, *redrawn))
    kept = roots & leaves(data.get("next")) - set(map(unravel_key, env.done_keys))
    for t, (before, after) in enumerate(zip(steps[:-1], steps[1:], strict=True)):
        require(
            not _ended(env, after).any(),
            f"{name}: step {t + 1} of a rollout starts in a state that is done. A reset must give "
            "a state from which an episode can continue.",
        )
        running = ~_ended(env, before.get("next"))
        require_same(
            before.get("next")[running],
            after[running],
            f"{name}: after step {t} <key> changed on the way to the next root. Only a transform "
            "may do that; if it is meant, name it in redrawn_keys.",
            kept,
        )


def _batch(env: EnvBase, seed: int, act: Policy) -> tuple[TensorDictBase, torch.Tensor]:
    """Return roots of several elements, a random step after a reset, and every other of them."""
    with during(_name(env), "stepping a batch"), seeded(seed):
        env.set_seed(seed)
        td = env.reset() if env.batch_size else env.reset(TensorDict(batch_size=[4]))
        _, td = env.step_and_maybe_reset(act(td))
    odd = torch.arange(td.batch_size.numel(), device=td.device) % 2
    return td, (odd == 0).reshape(td.batch_size)


def _check_partial_resets(env: EnvBase, seed: int, act: Policy) -> None:
    name = _name(env)
    before, mask = _batch(env, seed, act)
    asked = before.clone()
    for reset_key, done_keys in zip(env.reset_keys, env.done_keys_groups, strict=True):
        shape = before.get(done_keys[0]).shape
        asked.set(reset_key, expand_as_right(mask, before.get(done_keys[0])).expand(shape))
    with during(name, "resetting half of a batch"), seeded(seed):
        after = env.reset(asked, **({"set_state": False} if env._supports_set_state else {}))
    require_same(
        before[~mask],
        after[~mask],
        f'{name}: a reset of some elements changed <key> of others. Reset only where "_reset" is '
        "True.",
        leaves(before) & leaves(after),
    )
    for key in env.done_keys:
        require(
            not after[mask].get(key).any(),
            f"{name}: {key!r} is True right after a reset. Episodes begin with it False.",
        )


def _check_partial_steps(env: EnvBase, seed: int, act: Policy) -> None:
    name = _name(env)
    before, mask = _batch(env, seed, act)
    with seeded(seed):
        before = act(before)
    if mask.all():
        return  # a batch of one
    with during(name, "stepping half of a batch"), seeded(seed):
        env.set_seed(seed)
        after = env.step(before.clone().set("_step", mask)).get("next")
    if isinstance(env, TransformedEnv) and env.batch_locked:
        return  # transforms count on for all elements, and a rollout puts them back
    if env.batch_locked:  # of a stateless env TorchRL itself steps those that are asked for
        root = before.exclude("next", *env.action_keys)
        require_same(
            root[~mask],
            after[~mask],
            f'{name}: <key> changed where "_step" is False. Leave those elements as they are.',
            leaves(root) & {unravel_key(k) for k in env.full_observation_spec.keys(True, True)},
        )
        return
    with during(name, "stepping a batch"), seeded(seed):
        env.set_seed(seed)
        alone = env.step(before[mask].clone()).get("next")
    message = "<key> of elements that step depends on those beside them that do not."
    require_same(alone, after[mask], f"{name}: {message}")


def _check_beside(
    env: EnvBase, simulator: Simulator, data: TensorDictBase, tolerance: float
) -> None:
    """See that steps under way together give what they give one by one, in another order too."""
    steps = data.select(*simulator.root_keys, simulator.option_key).reshape(-1)
    expected = data.get("next").reshape(-1)
    with during(_name(env), "with several steps under way"):
        tickets = [env.step_async(steps[i : i + 1].clone()) for i in range(len(steps))]
        env.step_abandon(env.step_async(steps.clone()))
        found = [env.step_wait(ticket) for ticket in reversed(tickets)][::-1]
    for i, after in enumerate(found):
        require_same(
            expected[i : i + 1],
            after,
            f"{_name(env)}: step {i} of {len(found)} under way gave <key> = <other>, alone <one>. "
            "Keep apart what belongs to each ticket of step_async.",
            leaves(expected) & leaves(after),
            tolerance,
        )


def _check_set_state(
    env: EnvBase,
    simulator: Simulator,
    data: TensorDictBase,
    deterministic: bool,
    tolerance: float,
) -> None:
    """See that the env, set to the states of a rollout and stepped, gives the rollout."""
    name, env = _name(env), simulator.env  # in which transforms keep nothing to themselves
    written = {*env.full_observation_spec.keys(True, True), *env.done_keys}
    written |= set(env.full_reward_spec.keys(True, True))
    steps = data.unbind(-1) if env.batch_locked else [data.reshape(-1)]
    for step in steps:
        state, outcome = step.select(*simulator.root_keys), step.get("next")
        root = state.clone()
        if env._supports_set_state:  # without it a stateless env is stepped from the state itself
            with during(name, "reset to a state", "reset(td, set_state=True) must restore it."):
                root = env.reset(root, set_state=True)
        require_same(
            state,
            root,
            f"{name}: set to a state it shows another <key>: <other> instead of <one>. "
            "reset(td, set_state=True) must keep every entry of state_spec.",
            simulator.state_keys,
        )
        root.set(simulator.option_key, step.get(simulator.option_key).clone())
        held = root.clone()
        with during(name, "stepped from a state that it was set to"):
            after = env.step(root).get("next")
        require_same(
            held,
            root,
            f"{name}: a step changed <key> of its input. Write under 'next' only, and into new "
            "tensors.",
        )
        if deterministic:
            require_same(
                outcome,
                after,
                f"{name}: set to a state and stepped it gives <key> = <other>, the unbroken run "
                "gave <one>. Its state is not all in state_spec: declare every entry that _step "
                "reads. (For random outcomes pass deterministic=False.)",
                set(map(unravel_key, written)) & leaves(outcome),
                tolerance,
            )
