"""The contract of a transform: the eleven places in which TorchRL tests its own.

Letters: n transitions of a replay buffer.
"""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable, Sequence
from functools import partial

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torch import nn
from torchrl.data import LazyStackStorage, LazyTensorStorage, ReplayBuffer
from torchrl.envs import Compose, EnvBase, ParallelEnv, SerialEnv, Transform, TransformedEnv
from torchrl.envs.utils import check_env_specs

from torchrl_hmcts.nesting import flat_transforms
from torchrl_hmcts.testing.contract import (
    ContractError,
    during,
    leaves,
    refuse_unknown,
    require,
    require_kind,
    require_same,
    seeded,
)
from torchrl_hmcts.testing.env_checks import check_env, recorded, rollout

MakeTransform = Callable[[], Transform]
MakeEnv = Callable[[], EnvBase]

_PLACES = {
    "single": "on an env ('single')",
    "serial": "inside a SerialEnv ('serial')",
    "parallel": "inside a ParallelEnv ('parallel')",
    "trans_serial": "around a SerialEnv ('trans_serial')",
    "trans_parallel": "around a ParallelEnv ('trans_parallel')",
    "no_env": "on data without an env ('no_env')",
    "compose": "on data in a Compose ('compose')",
    "env": "in rollouts ('env')",
    "model": "in front of a network ('model')",
    "replay_buffer": "on a replay buffer ('replay_buffer')",
    "inverse": "in an inverse call ('inverse')",
    "state_dict": "loading the state dict of another ('state_dict')",
    "copy": "under a copy ('copy')",
    "device": "on an explicit device ('device')",
}
TRANSFORM_CHECKS = tuple(_PLACES)
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
    state_dict     goes into another transform of its kind, key by key, and its rollouts are alike
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
        ValueError: if there is no check of a name.

    Examples:
        >>> from torchrl.envs import StepCounter
        >>> from torchrl_hmcts.testing import ChainEnv, TRANSFORM_CHECKS, check_transform
        >>> check_transform(
        ...     StepCounter, ChainEnv, writes=["step_count"], checks=["single", "serial", "copy"])
    """
    refuse_unknown("check_transform", checks, TRANSFORM_CHECKS)
    it = _Transform(make_transform, make_env, start_method, num_steps)
    for check in checks:
        if check in ("serial", "parallel") and not inside_workers:
            _refuses(it, check, partial(it.specs_hold, check), "_check_batched_worker_compat")
        elif check in ("no_env", "compose", "model", "replay_buffer"):
            _on_data(it, check, data, {unravel_key(key) for key in data_writes})
        elif check == "env":
            _in_rollouts(it, writes, writes_next, changes)
            check_env(it.env(), num_steps=num_steps, redrawn_keys=redrawn_keys)
        elif check == "inverse":
            _inverse(it, {unravel_key(key) for key in inverse_writes})
        elif check == "state_dict":
            _state_dict(it)
        elif check == "copy":
            _copies(it)
        elif check == "device":
            _device(it)
        else:
            advice = "Let the transform_*_spec methods say exactly what it writes."
            with during(it.name, _PLACES[check], advice):
                it.specs_hold(check)


class _Transform:
    """The transform under test and its env."""

    def __init__(
        self, make: MakeTransform, make_env: MakeEnv, start_method: str | None, num_steps: int
    ) -> None:
        self.make, self.make_env, self.num_steps = make, make_env, num_steps
        self.start_method = start_method or "spawn"
        made = make()
        self.name = require_kind(made, Transform)
        require(
            made is not make(),
            f"make_transform gave the same {self.name} twice. Let it make a new one at each call: "
            "a transform serves one env.",
        )

    def env(self) -> TransformedEnv:
        return TransformedEnv(self.make_env(), self.make(), auto_unwrap=True)

    def specs_hold(self, check: str) -> None:
        """Make the env in which a check of specs is, and check them."""
        around = check.startswith("trans_")
        make = self.make_env if around else self.env
        if check == "single":
            env = self.env()
        elif check.endswith("parallel"):
            env = ParallelEnv(2, make, mp_start_method=self.start_method)
        else:
            env = SerialEnv(2, make)
        env = TransformedEnv(env, self.make()) if around else env
        try:
            with seeded(0):
                check_env_specs(env, break_when_any_done=False)
        finally:
            env.close(raise_if_closed=False)


def _refuses(it: _Transform, check: str, use: Callable[[], object], method: str) -> None:
    """Require ``use`` to raise an error that names the transform."""
    where, how = _PLACES[check], f"RuntimeError in {method}"
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
        f"{it.name} is silently accepted {where}, where it cannot work. Raise a {how}, or tell "
        "check_transform that it works there."
    )


def _on_data(
    it: _Transform, check: str, data: TensorDictBase | None, writes: set[NestedKey]
) -> None:
    given = it.env().rollout(3) if data is None else data
    size = len(given)

    def sample(transform: Transform) -> TensorDictBase:
        storage = LazyTensorStorage(size)
        buffer = ReplayBuffer(storage=storage, transform=transform, batch_size=2 * size)
        buffer.extend(given.clone())
        return buffer.sample()

    uses: dict[str, Callable[[Transform], TensorDictBase]] = {
        "no_env": lambda transform: transform(given.clone()),
        "compose": lambda transform: Compose(transform)(given.clone()),
        "model": lambda transform: nn.Sequential(transform, nn.Identity())(given.clone()),
        "replay_buffer": sample,
    }
    if data is None:
        _refuses(it, check, lambda: uses[check](it.make()), "forward")
        return
    where = _PLACES[check]
    with during(it.name, where), seeded(0):
        out = uses[check](it.make())
    for key in writes:
        require(
            out.get(key, None) is not None,
            f"{it.name} wrote no {key!r} {where}. Define forward, or name in data_writes what it "
            "writes.",
        )
    if check != "replay_buffer":
        message = "which is not among its data_writes. Name it there, or leave it."
        message = f"{it.name} changed <key> {where}, {message}"
        require_same(data, out, message, leaves(data) - writes)
        return
    for storage in (LazyTensorStorage(size), LazyStackStorage(size)):
        buffer = ReplayBuffer(storage=storage, transform=it.make(), batch_size=1)
        buffer.extend(given.clone())
        before = storage[:].clone()
        for look in (slice(None), 0):
            _ = buffer[look]
        require_same(
            before,
            storage[:],
            f"{it.name} changed what is stored in a {type(storage).__name__} {where} when it was "
            "only looked at (<key>). Write to a shallow copy: tensordict.copy().",
            leaves(before) | leaves(storage[:]),
        )


def _in_rollouts(
    it: _Transform,
    writes: Sequence[NestedKey],
    writes_next: Sequence[NestedKey],
    changes: Sequence[NestedKey],
) -> None:
    env, plain = it.env(), it.make_env()
    data = rollout(env, it.num_steps)
    for key in (*writes, *writes_next):
        require(
            data.get(("next", key), None) is not None,
            f"{it.name} wrote no {('next', key)!r} in a rollout. Write it in _step.",
        )
        in_root = data.get(key, None) is not None
        require(
            in_root or key in writes_next,
            f"{it.name} wrote no {key!r} at the root of a rollout. Write it in _reset too.",
        )
        require(
            not in_root or key in writes,
            f"{it.name} wrote {key!r} at the root too. Name it in writes.",
        )
    if set(env.action_keys) == set(plain.action_keys):
        reference = rollout(plain, it.num_steps, 0, recorded(data, env))
        own = {unravel_key(key) for key in (*writes, *writes_next, *changes)}
        own |= {unravel_key(("next", key)) for key in own}
        require_same(
            reference,
            data,
            f"{it.name} changed <key> of the env, which is not among its changes. Name it there, "
            "or leave it. (It may also draw random numbers that the env needs: then give one of "
            "the two a generator of its own.)",
            leaves(reference) - own,
        )
    env.close()
    plain.close()


def _inverse(it: _Transform, writes: set[NestedKey]) -> None:
    env = it.env()
    with during(it.name, _PLACES["inverse"]), seeded(0):
        td = env.rand_action(env.reset())
        out = flat_transforms(env)[-1].inv(td.clone())
    for key in writes:
        require(
            out.get(key, None) is not None,
            f"{it.name}.inv wrote no {key!r}. Set it in _inv_call from the outer action.",
        )
    message = "which is not among its inverse_writes. Name it there, or leave it."
    require_same(td, out, f"{it.name}.inv changed <key>, {message}", leaves(td) - writes)


def _state_dict(it: _Transform) -> None:
    first, second = it.env(), it.env()
    rollout(first, it.num_steps)  # what is made at the first use would be missing from the state
    state = copy.deepcopy(first.state_dict())
    advice = "Make all that is saved in __init__, in buffers or get_extra_state."
    with during(it.name, _PLACES["state_dict"], advice):
        second.load_state_dict(state)
    where = _unequal_state(state, second.state_dict())
    require(
        where is None,
        f"{it.name}: {where!r} of the state dict is another after it was loaded. {advice}",
    )
    require_same(
        rollout(first, it.num_steps, 1),
        rollout(second, it.num_steps, 1),
        f"{it.name}: with its state dict in another env <key> continues otherwise. {advice}",
    )


def _unequal_state(one: dict, two: dict) -> str | None:
    """Return the first entry of two state dicts that differs, or None."""
    for key in sorted({*one, *two}):
        a, b = one.get(key), two.get(key)
        below = _unequal_state(a, b) if isinstance(a, dict) and isinstance(b, dict) else None
        if below is not None:
            return f"{key}.{below}"
        if (key in one) != (key in two):
            return str(key)
        if isinstance(a, torch.Tensor) and isinstance(b, torch.Tensor) and not torch.equal(a, b):
            return str(key)
    return None


def _copies(it: _Transform) -> None:
    env, twins = it.env(), {}
    rollout(env, 2)
    advice = "Keep nothing that cannot be copied."
    with during(it.name, _PLACES["copy"], advice):
        twins["a deep copy"] = copy.deepcopy(env)
    try:
        pickle.dumps(it.make_env())
    except Exception:
        pass  # the env itself cannot be pickled
    else:
        with during(it.name, _PLACES["copy"], advice):
            twins["a pickle"] = pickle.loads(pickle.dumps(env))
    expected = rollout(env, it.num_steps, 1)
    for how, twin in twins.items():
        message = "of the env gives another <key>. A copy must share nothing that changes and lose"
        message = f"{it.name}: {how} {message} nothing."
        require_same(expected, rollout(twin, it.num_steps, 1), message)


def _device(it: _Transform) -> None:
    device = torch.device("cpu")
    env = TransformedEnv(it.make_env().to(device), it.make(), auto_unwrap=True)
    with during(it.name, _PLACES["device"]):
        data = rollout(env, it.num_steps)
    require(
        data.device == device,
        f"{it.name}: on an env of device {device} a rollout has device {data.device}. Make tensors "
        "on the device of the tensordict.",
    )
    for kind in ("observation", "state", "action", "reward", "done"):
        for key, leaf in getattr(env, f"full_{kind}_spec").items(True, True):
            require(
                leaf.device == device,
                f"{it.name}: the {kind} spec of {key!r} has device {leaf.device} on an env of "
                f"device {device}. Give the specs it makes the device of the spec they go into.",
            )
