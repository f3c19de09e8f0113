"""The contract of a transform: the eleven places in which TorchRL tests its own.

Letters: n transitions of a replay buffer.
"""

from __future__ import annotations

import copy
import functools
import pickle
from collections.abc import Callable, Sequence

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torch import nn
from torchrl.data import LazyStackStorage, LazyTensorStorage, ReplayBuffer, Storage
from torchrl.envs import Compose, EnvBase, ParallelEnv, SerialEnv, Transform, TransformedEnv
from torchrl.envs.utils import check_env_specs

from torchrl_hmcts.testing.claims import ContractError, different, during, leaves, require, seeded
from torchrl_hmcts.testing.env_checks import check_env

MakeTransform = Callable[[], Transform]
MakeEnv = Callable[[], EnvBase]

TRANSFORM_CHECKS = (
    "single",
    "serial",
    "parallel",
    "trans_serial",
    "trans_parallel",
    "no_env",
    "compose",
    "env",
    "model",
    "replay_buffer",
    "inverse",
    "state_dict",
    "copy",
    "device",
)
"""The names of what :func:`check_transform` checks, in order."""


def check_transform(
    make_transform: MakeTransform,
    make_env: MakeEnv,
    *,
    writes: Sequence[NestedKey] = (),
    writes_next: Sequence[NestedKey] = (),
    changes: Sequence[NestedKey] = (),
    redrawn_keys: Sequence[NestedKey] = (),
    data: TensorDictBase | None = None,
    data_writes: Sequence[NestedKey] = (),
    inverse_writes: Sequence[NestedKey] = (),
    inside_workers: bool = True,
    start_method: str | None = None,
    num_steps: int = 6,
    checks: Sequence[str] = TRANSFORM_CHECKS,
) -> None:
    """Check a transform in each of the places where users put transforms.

    ============== ==============================================================================
    single         on an env: specs hold
    serial         in the envs of a ``SerialEnv``: specs hold, or it refuses to be there
    parallel       the same in the processes of a ``ParallelEnv``
    trans_serial   around a ``SerialEnv``: specs hold
    trans_parallel around a ``ParallelEnv``: specs hold
    no_env         called on data, or it refuses data
    compose        the same in a ``Compose``
    env            rollouts: what it writes is there, all else is as without it; :func:`check_env`
    model          in front of a network, or it refuses data
    replay_buffer  on a replay buffer: samples hold what it writes and what is stored stays as it
                   is, or it refuses data
    inverse        ``inv`` writes the inner action, or leaves a tensordict as it is
    state_dict     goes into another transform of its kind, key by key, and its rollouts go on alike
    copy           a deep copy and a pickle of the env step as the env does
    device         on an explicit device all entries and specs are there
    ============== ==============================================================================

    "It refuses" means that an error names the transform, instead of silently doing nothing.

    Args:
        make_transform (callable): makes the transform, a new one at each call.
        make_env (callable): makes the env without it, a new one at each call, unbatched or batched.
        writes (sequence of NestedKey): entries it adds to the root and to ``"next"``.
        writes_next (sequence of NestedKey): entries it adds to ``"next"`` only.
        changes (sequence of NestedKey): entries of the env that it changes, e.g. ``"reward"``.
            If it changes which actions there are, outcomes are not compared at all.
        redrawn_keys (sequence of NestedKey): as in :func:`check_env`.
        data (TensorDictBase, optional): transitions ``[n]`` for a transform that works on stored
            data. Default: it does not, and has to say so.
        data_writes (sequence of NestedKey): what it writes into ``data``, e.g.
            ``("next", "reward")``.
        inverse_writes (sequence of NestedKey): what its ``inv`` writes: the env's own action. The
            default is none.
        inside_workers (bool): whether it may stand inside a ``SerialEnv`` or ``ParallelEnv``.
            Default ``True``; with ``False`` it has to refuse.
        start_method (str, optional): how a ``ParallelEnv`` starts its processes. Default: TorchRL's
            own, ``"spawn"``, which takes longer than ``"fork"``.
        num_steps (int): steps of the rollouts. Default 6.
        checks (sequence of str): which of the above. Default: all. The two of ``ParallelEnv`` start
            processes and take longest.

    Raises:
        ContractError: if one of them fails; the message names it.
        ValueError: if there is no check of a name.

    Examples:
        >>> from torchrl.envs import StepCounter
        >>> from torchrl_hmcts.testing import ChainEnv, TRANSFORM_CHECKS, check_transform
        >>> check_transform(
        ...     StepCounter, ChainEnv, writes=["step_count"], checks=["single", "serial", "copy"])
    """
    unknown = [check for check in checks if check not in TRANSFORM_CHECKS]
    if unknown:
        raise ValueError(
            f"check_transform has no check {unknown[0]!r}; it has {', '.join(TRANSFORM_CHECKS)}."
        )
    it = _Transform(make_transform, make_env, start_method)
    for check in checks:
        if check == "single":
            _specs_hold(it, check, it.env())
        elif check in ("serial", "parallel"):
            _inside(it, check, inside_workers)
        elif check in ("trans_serial", "trans_parallel"):
            batched = it.batched(check, make_env)
            _specs_hold(it, check, functools.partial(_transformed, batched, make_transform))
        elif check in ("no_env", "compose", "model", "replay_buffer"):
            _on_data(it, check, data, data_writes)
        elif check == "env":
            _in_rollouts(it, writes, writes_next, changes, redrawn_keys, num_steps)
        elif check == "inverse":
            _inverse(it, inverse_writes)
        elif check == "state_dict":
            _state_dict(it, num_steps)
        elif check == "copy":
            _copies(it, num_steps)
        else:
            _device(it, num_steps)


class _Transform:
    """The transform under test and its env."""

    def __init__(
        self, make_transform: MakeTransform, make_env: MakeEnv, start_method: str | None
    ) -> None:
        self.make, self.make_env, self.start_method = make_transform, make_env, start_method
        made = make_transform()
        self.name = type(made).__name__
        if not isinstance(made, Transform):
            raise ContractError(
                f"{self.name} is no torchrl.envs.Transform. Derive it from that class."
            )
        if made is make_transform():
            raise ContractError(
                f"make_transform gave the same {self.name} twice. Let it make a new one at each "
                "call: a transform serves one env."
            )

    def env(self) -> TransformedEnv:
        return TransformedEnv(self.make_env(), self.make(), auto_unwrap=True)

    def batched(self, check: str, make_env: MakeEnv) -> SerialEnv | ParallelEnv:
        """Two envs in one, of the kind that the name of a check asks for."""
        if not check.endswith("parallel"):
            return SerialEnv(2, make_env)
        return ParallelEnv(2, make_env, mp_start_method=self.start_method or "spawn")

    def rollout(self, env: EnvBase, num_steps: int, seed: int = 0) -> TensorDictBase:
        with seeded(seed):
            env.set_seed(seed)
            return env.rollout(num_steps, break_when_any_done=False)


def _specs_hold(it: _Transform, check: str, env: EnvBase | Callable[[], EnvBase]) -> None:
    places = {
        "single": "on an env",
        "serial": "inside a SerialEnv",
        "parallel": "inside a ParallelEnv",
        "trans_serial": "around a SerialEnv",
        "trans_parallel": "around a ParallelEnv",
    }
    made: EnvBase | None = env if isinstance(env, EnvBase) else None
    try:
        advice = "Let the transform_*_spec methods say exactly what it writes."
        with during(it.name, f"{places[check]} ({check!r})", advice), seeded(0):
            if made is None:
                made = env()
            check_env_specs(made, break_when_any_done=False)
    finally:
        if made is not None and not made.is_closed:
            made.close()


def _inside(it: _Transform, check: str, allowed: bool) -> None:
    if allowed:
        _specs_hold(it, check, lambda: it.batched(check, it.env))
        return

    def use() -> None:
        env = it.batched(check, it.env)
        try:
            env.rollout(2)
        finally:
            env.close(raise_if_closed=False)

    _refuses(it, f"inside a {check.capitalize()}Env ({check!r})", use, "RuntimeError in "
             "_check_batched_worker_compat")  # fmt: skip


def _refuses(it: _Transform, where: str, use: Callable[[], object], how: str) -> None:
    """``use`` must raise an error that names the transform."""
    try:
        use()
    except Exception as error:
        require(
            it.name in str(error),
            f"{it.name} fails {where} with {type(error).__name__}: {error!s:.300}, which does not "
            f"name it. Raise a {how} that says what to do instead.",
        )
        return
    raise ContractError(
        f"{it.name} is silently accepted {where}, where it was said not to work. Raise a {how}, or "
        "tell check_transform that it works there."
    )


def _on_data(
    it: _Transform, check: str, data: TensorDictBase | None, keys: Sequence[NestedKey]
) -> None:
    where = {
        "no_env": "on data without an env",
        "compose": "on data in a Compose",
        "model": "in front of a network",
        "replay_buffer": "on a replay buffer",
    }[check] + f" ({check!r})"
    given = it.env().rollout(3) if data is None else data

    def use() -> TensorDictBase:
        transform = it.make()
        if check == "no_env":
            return transform(given.clone())
        if check == "compose":
            return Compose(transform)(given.clone())
        if check == "model":
            return nn.Sequential(transform, nn.Identity())(given.clone())
        size = len(given)
        buffer = ReplayBuffer(
            storage=LazyTensorStorage(size), transform=transform, batch_size=2 * size
        )
        buffer.extend(given.clone())
        return buffer.sample()

    if data is None:
        _refuses(it, where, use, "RuntimeError in forward")
        return
    with during(it.name, where), seeded(0):
        out = use()
    for key in keys:
        value = out.get(key, None)
        require(
            value is not None,
            f"{it.name} wrote no {key!r} {where}. Define forward, or name in data_writes what it "
            "writes.",
        )
    if check == "replay_buffer":
        _leaves_stored(it, where, data)
    else:
        changed = different(data, out, leaves(data) - set(map(unravel_key, keys)))
        require(
            changed is None,
            f"{it.name} changed {changed and changed[0]!r} {where}, which it is not said to write. "
            "Name it in data_writes, or leave it.",
        )


def _leaves_stored(it: _Transform, where: str, given: TensorDictBase) -> None:
    """Look at stored data through the transform, and require that they are as they were."""
    storages: list[Storage] = [LazyTensorStorage(len(given)), LazyStackStorage(len(given))]
    for storage in storages:
        buffer = ReplayBuffer(storage=storage, transform=it.make(), batch_size=1)
        buffer.extend(given.clone())
        before = storage[:].clone()
        for look in (slice(None), 0):
            _ = buffer[look]
        held = storage[:]
        require(
            leaves(held) == leaves(before) and different(before, held, leaves(before)) is None,
            f"{it.name} changed what is stored in a {type(storage).__name__} {where} when it was "
            "only looked at. Write to a shallow copy: tensordict.copy().",
        )


def _in_rollouts(
    it: _Transform,
    writes: Sequence[NestedKey],
    writes_next: Sequence[NestedKey],
    changes: Sequence[NestedKey],
    redrawn: Sequence[NestedKey],
    num_steps: int,
) -> None:
    env, plain = it.env(), it.make_env()
    data = it.rollout(env, num_steps)
    after = data.get("next")
    for key in (*writes, *writes_next):
        require(
            after.get(key, None) is not None,
            f"{it.name} wrote no {('next', key)!r} in a rollout. Write it in _step.",
        )
    for key in writes:
        require(
            data.get(key, None) is not None,
            f"{it.name} wrote no {key!r} at the root of a rollout. Write it in _reset too.",
        )
    for key in writes_next:
        require(
            data.get(key, None) is None,
            f"{it.name} wrote {key!r} at the root too. Name it in writes.",
        )
    if set(env.action_keys) == set(plain.action_keys):
        actions = iter(data.select(*env.action_keys).unbind(-1))
        with seeded(0):
            plain.set_seed(0)
            reference = plain.rollout(
                num_steps, lambda td: td.update(next(actions)), break_when_any_done=False
            )
        own = {unravel_key(key) for key in (*writes, *writes_next, *changes)}
        own |= {unravel_key(("next", key)) for key in own}
        where = different(reference, data, sorted(leaves(reference) - own, key=str))
        require(
            where is None,
            f"{it.name} changed {where and where[0]!r} of the env, which it is not said to. Name "
            "it in changes, or leave it. (It may also draw random numbers that the env needs: "
            "then give one of the two a generator of its own.)",
        )
    env.close()
    plain.close()
    check_env(it.env(), num_steps=num_steps, redrawn_keys=redrawn)


def _inverse(it: _Transform, keys: Sequence[NestedKey]) -> None:
    env = it.env()
    with during(it.name, "in an inverse call ('inverse')"), seeded(0):
        td = env.rand_action(env.reset())
        before = td.clone()
        own = env.transform[-1] if isinstance(env.transform, Compose) else env.transform
        out = own.inv(td.clone())
    for key in keys:
        require(
            out.get(key, None) is not None,
            f"{it.name}.inv wrote no {key!r}. Set it in _inv_call from the outer action.",
        )
    kept = leaves(before) - set(map(unravel_key, keys))
    where = different(before, out, kept) if kept <= leaves(out) else (sorted(kept, key=str)[0], 0)
    require(
        where is None,
        f"{it.name}.inv changed {where and where[0]!r}, which it is not said to write. Name it in "
        "inverse_writes, or leave it.",
    )


def _state_dict(it: _Transform, num_steps: int) -> None:
    first, second = it.env(), it.env()
    it.rollout(first, num_steps)  # what is made at the first use would be missing from the state
    state = copy.deepcopy(first.state_dict())
    advice = "Make all that is saved in __init__, in buffers or get_extra_state."
    with during(it.name, "loading the state dict of another ('state_dict')", advice):
        second.load_state_dict(state)
    where = _unequal_state(state, second.state_dict())
    require(
        where is None,
        f"{it.name}: {where!r} of the state dict is another after it was loaded. {advice}",
    )
    one, two = it.rollout(first, num_steps, 1), it.rollout(second, num_steps, 1)
    other = different(one, two, sorted(leaves(one), key=str))
    require(
        other is None,
        f"{it.name}: with its state dict in another env {other and other[0]!r} goes on otherwise. "
        f"{advice}",
    )


def _unequal_state(one: dict, two: dict) -> str | None:
    """The first entry of two state dicts that differs, or None."""
    if set(one) != set(two):
        return str(sorted(set(one) ^ set(two), key=str)[0])
    for key, value in one.items():
        other = two[key]
        if isinstance(value, dict):
            below = _unequal_state(value, other)
            if below is not None:
                return f"{key}.{below}"
        elif isinstance(value, torch.Tensor):
            if not torch.equal(value, other):
                return str(key)
    return None


def _copies(it: _Transform, num_steps: int) -> None:
    env = it.env()
    it.rollout(env, 2)
    ways: tuple[tuple[str, Callable[[EnvBase], EnvBase]], ...] = (
        ("a deep copy", copy.deepcopy),
        ("a pickle", lambda e: pickle.loads(pickle.dumps(e))),
    )
    twins: list[tuple[str, EnvBase]] = []
    for how, duplicate in ways:
        try:
            with during(it.name, f"under {how} ('copy')", "Keep nothing that cannot be copied."):
                twins.append((how, duplicate(env)))
        except ContractError:
            if how == "a pickle" and _cannot_pickle(it.make_env()):
                continue  # the env itself cannot be pickled
            raise
    expected = it.rollout(env, num_steps, 1)
    for how, twin in twins:
        where = different(expected, it.rollout(twin, num_steps, 1), leaves(expected))
        require(
            where is None,
            f"{it.name}: {how} of the env gives another {where and where[0]!r}. A copy must share "
            "nothing that changes and lose nothing.",
        )


def _cannot_pickle(env: EnvBase) -> bool:
    try:
        pickle.dumps(env)
    except Exception:
        return True
    return False


def _device(it: _Transform, num_steps: int) -> None:
    device = torch.device("cpu")
    env = TransformedEnv(it.make_env().to(device), it.make(), auto_unwrap=True)
    with during(it.name, "on an explicit device ('device')"):
        data = it.rollout(env, num_steps)
    require(
        data.device == device,
        f"{it.name}: on an env of device {device} a rollout has device {data.device}. Make tensors "
        "on the device of the tensordict.",
    )
    for kind in ("observation", "state", "action", "reward", "done"):
        spec = getattr(env, f"full_{kind}_spec")
        for key, leaf in spec.items(True, True):
            require(
                leaf.device == device,
                f"{it.name}: the {kind} spec of {key!r} has device {leaf.device} on an env of "
                f"device {device}. Give the specs it makes the device of the spec they go into.",
            )


def _transformed(env: EnvBase, make_transform: Callable[[], Transform]) -> TransformedEnv:
    return TransformedEnv(env, make_transform())
