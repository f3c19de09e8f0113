"""Checks of environments: specs, resets, states, workers.

Letters: *B batch of a tensordict, T steps of a rollout, m states stepped at once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torch.nn.functional import one_hot
from torchrl.data import Categorical, OneHot
from torchrl.envs import Compose, EnvBase, ParallelEnv, SerialEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs

from torchrl_hmcts.carried_state import ForeignStates
from torchrl_hmcts.planners.simulator import Simulator
from torchrl_hmcts.testing.claims import (
    ContractError,
    different,
    during,
    leaves,
    require,
    row,
    seeded,
)


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

    TorchRL's ``check_env_specs``, with episodes that go on after their end; the same seed gives the
    same rollout; the next step begins where the last one ended, and after the end of an episode in
    a new one; a reset of some elements leaves the others as they are; of elements of which some are
    not to step the others step as they do alone, and the former stay where they are.

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

    Raises:
        ContractError: if it does not.

    Examples:
        >>> from torchrl_hmcts.testing import ChainEnv, check_env
        >>> check_env(ChainEnv(length=4))
    """
    name = _name(env)
    with during(name, "TorchRL's check_env_specs", "Correct the specs, or what is written."):
        with seeded(seed):
            env.set_seed(seed)
            check_env_specs(env, break_when_any_done="both")
    act = _Random(env, mask_key)
    data = _rollout(env, num_steps, seed, act)
    if seeds_repeat:
        again = _rollout(env, num_steps, seed, act)
        where = different(data, again, sorted(leaves(data), key=str))
        require(
            where is None,
            f"{name}: two rollouts with seed {seed} differ in {where and where[0]!r}. Draw every "
            "random number from a generator that _set_seed seeds.",
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
    """Check that a planner can search an env: a macro environment, one that is set to states.

    All of :func:`check_env`, and: the action is one discrete option; a step takes at least one base
    step; some option may be taken wherever an episode goes on; set to the states of a rollout and
    stepped with its options the env gives what the unbroken rollout gave, for all of them at once
    if it is stateless; a step leaves its input as it was; transforms of your own keep no tensor to
    themselves that changes from step to step. With ``step_async``, ``step_wait`` and
    ``step_abandon``: steps that are under way at the same time do not touch each other.

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
    _rollout(env, num_steps, seed, _Random(env, mask_key))
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
    data = _rollout(env, num_steps, seed, _Random(env, mask_key))
    duration_key, mask_key = unravel_key(duration_key), unravel_key(mask_key)
    if simulator.duration_key is not None:
        duration = data.get("next").get(duration_key)
        shape = (*data.batch_size, 1)
        require(
            duration.dtype == torch.int64 and duration.shape == torch.Size(shape),
            f"{name}: the duration under {duration_key!r} is {duration.dtype} "
            f"{list(duration.shape)}; it must be int64 {list(shape)}, one number per step.",
        )
        require(
            (duration >= 1).all(),
            f"{name}: a step took {int(duration.min())} base steps ({duration_key!r}). Each takes "
            "at least one, or a search would go round in a circle without any discount.",
        )
    if simulator.mask_key is not None:
        mask = data.get("next").get(mask_key)
        stuck = ~mask.any(-1) & ~data.get("next").get(env.done_keys[0]).squeeze(-1)
        require(
            not stuck.any(),
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
    """Check that an env does in the processes of a ``ParallelEnv`` what it does in this one.

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
            expected = _rollout(serial, num_steps, seed, _Random(serial, "action_mask"))
    finally:
        serial.close(raise_if_closed=False)
    for method in start_methods:
        where = f"in a ParallelEnv of {num_workers} processes started by {method}"
        with during(name, where, "Keep nothing in the env that cannot go to another process."):
            parallel = ParallelEnv(num_workers, make_env, mp_start_method=method)
            try:
                with seeded(seed):
                    check_env_specs(parallel)
                actual = _replay(parallel, expected, seed)
            finally:
                parallel.close(raise_if_closed=False)
        other = different(expected, actual, sorted(leaves(expected), key=str))
        require(
            other is None,
            f"{name}: {other and other[0]!r} is another {where} than in a SerialEnv, with the same "
            f"seed and actions. Let _set_seed seed all that is random, and share no state between "
            "envs.",
        )


def _name(env: EnvBase) -> str:
    if not isinstance(env, EnvBase):
        raise ContractError(
            f"{type(env).__name__} is no torchrl.envs.EnvBase. Wrap it, e.g. with GymWrapper."
        )
    transforms: list[str] = []
    while isinstance(env, TransformedEnv):
        inner = env.transform
        parts = list(inner) if isinstance(inner, Compose) else [inner]
        transforms = [type(part).__name__ for part in parts] + transforms
        env = env.base_env
    name = type(env).__name__
    return f"{name} under {', '.join(transforms)}" if transforms else name


class _Random:
    """A policy that draws actions from the spec, and options from the mask if the env has one."""

    def __init__(self, env: EnvBase, mask_key: NestedKey) -> None:
        self.env = env
        self.mask_key = unravel_key(mask_key)
        spec = env.full_action_spec[env.action_keys[0]]
        self.one_hot = isinstance(spec, OneHot)
        self.masked = isinstance(spec, (OneHot, Categorical))

    def __call__(self, td: TensorDictBase) -> TensorDictBase:
        td = self.env.rand_action(td)
        mask = td.get(self.mask_key, None)
        if mask is None or not self.masked:
            return td
        weights = (mask | ~mask.any(-1, keepdim=True)).to(torch.float32)
        option = torch.multinomial(weights.flatten(0, -2) if mask.ndim > 1 else weights, 1)
        option = option.reshape(mask.shape[:-1])
        old = td.get(self.env.action_keys[0])
        if self.one_hot:
            return td.set(self.env.action_keys[0], one_hot(option, mask.shape[-1]).to(old.dtype))
        return td.set(self.env.action_keys[0], option.reshape(old.shape).to(old.dtype))


def _rollout(env: EnvBase, num_steps: int, seed: int, act: _Random) -> TensorDictBase:
    """A random rollout ``[*B, T]`` through the ends of episodes."""
    with seeded(seed):
        env.set_seed(seed)
        return env.rollout(num_steps, act, break_when_any_done=False)


def _replay(env: EnvBase, data: TensorDictBase, seed: int) -> TensorDictBase:
    """The rollout of another env with the same seed and the actions of ``data``."""
    actions = iter(data.select(*env.action_keys).unbind(-1))

    def policy(td: TensorDictBase) -> TensorDictBase:
        return td.update(next(actions))

    with seeded(seed):
        env.set_seed(seed)
        return env.rollout(data.batch_size[-1], policy, break_when_any_done=False)


def _check_continuity(env: EnvBase, data: TensorDictBase, redrawn: set[NestedKey]) -> None:
    """What a step wrote is where the next one starts, until the end of the episode."""
    name, last = _name(env), data.batch_dims - 1
    steps = data.unbind(last)
    roots = leaves(data.exclude("next", *env.action_keys, *redrawn))
    kept = roots & leaves(data.get("next"))
    done_keys = set(map(unravel_key, env.done_keys))
    for t, (before, after) in enumerate(zip(steps[:-1], steps[1:], strict=True)):
        following = before.get("next")
        ended = torch.zeros(before.batch_size, dtype=torch.bool, device=before.device)
        for key in env.done_keys:
            done = following.get(key)
            ended |= done.reshape(*before.batch_size, -1).any(-1)
        begun = torch.zeros_like(ended)
        for key in done_keys:
            begun |= after.get(key).reshape(*before.batch_size, -1).any(-1)
        require(
            not begun.any(),
            f"{name}: step {t + 1} of a rollout starts in a state that is done. A reset must give "
            "a state from which an episode can go on.",
        )
        if ended.all():
            continue
        goes_on = ~ended
        one, two = following[goes_on], after[goes_on]
        where = different(one, two, sorted(kept - done_keys, key=str))
        require(
            where is None,
            f"{name}: after step {t} {where and where[0]!r} changed on the way to the next root. "
            "Only a transform may do that; if it is meant, name it in redrawn_keys.",
        )


def _batch(env: EnvBase, seed: int, act: _Random) -> TensorDictBase:
    """Roots of several elements, one random step after a reset."""
    with seeded(seed):
        env.set_seed(seed)
        td = env.reset() if env.batch_size else env.reset(TensorDict(batch_size=[4]))
        _, td = env.step_and_maybe_reset(act(td))
    return td


def _half(td: TensorDictBase) -> torch.Tensor:
    """Every other element, bool ``[*B]``."""
    n = td.batch_size.numel()
    return (torch.arange(n, device=td.device) % 2 == 0).reshape(td.batch_size)


def _check_partial_resets(env: EnvBase, seed: int, act: _Random) -> None:
    name = _name(env)
    with during(name, "stepping a batch"):
        before = _batch(env, seed, act)
    mask = _half(before)
    asked = before.clone()
    for reset_key, done_keys in zip(env.reset_keys, env.done_keys_groups, strict=True):
        shape = before.get(done_keys[0]).shape
        asked.set(
            reset_key, mask.reshape(*mask.shape, *[1] * (len(shape) - mask.ndim)).expand(shape)
        )
    with during(name, "resetting half of a batch"), seeded(seed):
        after = env.reset(asked, **({"set_state": False} if env._supports_set_state else {}))
    rest = ~mask
    if rest.any():
        keys = leaves(before) & leaves(after)
        where = different(before[rest], after[rest], sorted(keys, key=str))
        require(
            where is None,
            f"{name}: a reset of some elements changed {where and where[0]!r} of others. Reset "
            'only where "_reset" is True.',
        )
    for key in env.done_keys:
        require(
            not after[mask].get(key).any(),
            f"{name}: {key!r} is True right after a reset. Episodes begin with it False.",
        )


def _check_partial_steps(env: EnvBase, seed: int, act: _Random) -> None:
    name = _name(env)
    before = _batch(env, seed, act)
    with seeded(seed):
        before = act(before)
    mask = _half(before)
    if mask.all():
        return  # a batch of one
    asked = before.clone().set("_step", mask)
    with during(name, "stepping half of a batch"), seeded(seed):
        env.set_seed(seed)
        after = env.step(asked).get("next")
    rest = ~mask
    if isinstance(env, TransformedEnv) and env.batch_locked:
        return  # transforms count on for all elements, and a rollout puts them back
    if env.batch_locked:  # of a stateless env TorchRL itself steps those that are asked for
        root = before.exclude("next", *env.action_keys)
        keys = {unravel_key(key) for key in env.full_observation_spec.keys(True, True)}
        keys = {key for key in keys if root.get(key, None) is not None}
        where = different(root[rest], after[rest], sorted(keys, key=str))
        require(
            where is None,
            f'{name}: {where and where[0]!r} changed where "_step" is False. Leave those elements '
            "as they are.",
        )
    else:
        with during(name, "stepping a batch"), seeded(seed):
            env.set_seed(seed)
            alone = env.step(before[mask].clone()).get("next")
        where = different(alone, after[mask], sorted(leaves(alone), key=str))
        require(
            where is None,
            f"{name}: {where and where[0]!r} of elements that step depends on those beside them "
            "that do not.",
        )


def _check_beside(
    env: EnvBase, simulator: Simulator, data: TensorDictBase, tolerance: float
) -> None:
    """Begun together and waited for in another order, steps give what they give one by one."""
    name = _name(env)
    steps = data.select(*simulator.root_keys, simulator.option_key).reshape(-1)
    expected = data.get("next").reshape(-1)
    with during(name, "with several steps under way"):
        tickets = [env.step_async(steps[i : i + 1].clone()) for i in range(len(steps))]
        env.step_abandon(env.step_async(steps.clone()))
        found = [env.step_wait(ticket) for ticket in reversed(tickets)][::-1]
    for i, after in enumerate(found):
        outcome = expected[i : i + 1]
        keys = sorted(set(leaves(outcome)) & set(leaves(after)), key=str)
        where = different(outcome, after, keys, tolerance)
        require(
            where is None,
            f"{name}: step {i} of {len(found)} under way gave {where and where[0]!r} = "
            f"{where and row(after, *where)}, alone {where and row(outcome, *where)}. Keep apart "
            "what belongs to each ticket of step_async.",
        )


def _check_set_state(
    env: EnvBase,
    simulator: Simulator,
    data: TensorDictBase,
    deterministic: bool,
    tolerance: float,
) -> None:
    """Set to the states of a rollout and stepped, the env gives the rollout."""
    name, env = _name(env), simulator.env  # in which transforms keep nothing to themselves
    option_key = simulator.option_key
    roots = data.select(*simulator.root_keys)
    options = data.get(option_key)
    if env.batch_locked:
        batches = list(zip(roots.unbind(-1), options.unbind(data.batch_dims - 1), strict=True))
        expected = list(data.get("next").unbind(-1))
    else:
        batches = [(roots.reshape(-1), options.flatten(0, data.batch_dims - 1))]
        expected = [data.get("next").reshape(-1)]
    written = set(map(unravel_key, env.full_observation_spec.keys(True, True)))
    written |= {unravel_key(k) for k in (*env.full_reward_spec.keys(True, True), *env.done_keys)}
    for (state, option), outcome in zip(batches, expected, strict=True):
        root = state.clone()
        if env._supports_set_state:  # without it a stateless env is stepped from the state itself
            with during(name, "reset to a state", "reset(td, set_state=True) must restore it."):
                root = env.reset(root, set_state=True)
        where = different(state, root, simulator.state_keys)
        require(
            where is None,
            f"{name}: set to a state it shows another {where and where[0]!r}: "
            f"{where and row(root, *where)} instead of {where and row(state, *where)}. "
            "reset(td, set_state=True) must keep every entry of state_spec.",
        )
        root.set(option_key, option.clone())
        held = root.clone()
        with during(name, "stepped from a state that it was set to"):
            after = env.step(root).get("next")
        where = different(held, root, leaves(held))
        require(
            where is None,
            f"{name}: a step changed {where and where[0]!r} of its input. Write under 'next' only, "
            "and into new tensors.",
        )
        if not deterministic:
            continue
        keys = {key for key in written if outcome.get(key, None) is not None}
        where = different(outcome, after, sorted(keys, key=str), tolerance)
        require(
            where is None,
            f"{name}: set to a state and stepped it gives {where and where[0]!r} = "
            f"{where and row(after, *where)}, the unbroken run gave "
            f"{where and row(outcome, *where)}. Its state is not all in state_spec: declare every "
            "entry that _step reads. (For random outcomes pass deterministic=False.)",
        )
