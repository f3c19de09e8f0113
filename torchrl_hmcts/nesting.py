"""The envs and transforms that an env is made of, and the parts of a nested key."""

from __future__ import annotations

from collections.abc import Iterator

from tensordict import TensorDictBase, unravel_key
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Composite
from torchrl.envs import Compose, EnvBase, Transform, TransformedEnv
from torchrl.envs.batched_envs import BatchedEnvBase

_DEFAULT_GAMMA = 0.99


def parts(key: NestedKey) -> tuple[str, ...]:
    """Return the names of which a nested key consists."""
    return (key,) if isinstance(key, str) else key


def given(tensordict: TensorDictBase, key: NestedKey) -> Tensor | None:
    """Return an entry that a reset is to keep; None where it begins episodes."""
    begins = any(parts(k)[-1] == "_reset" for k in tensordict.keys(True, True))
    return None if begins else tensordict.get(key, None)


def innermost(env: EnvBase) -> EnvBase:
    """Return the env below all transforms; it asks no env for an attribute that it may lack."""
    while isinstance(env, TransformedEnv):
        env = env.base_env
    return env


def env_name(env: EnvBase) -> str:
    """Return the type of the env below all transforms, for an error."""
    return type(innermost(env)).__name__


def flat_transforms(env: TransformedEnv | Transform) -> list[Transform]:
    """Return the transforms of one TransformedEnv or Compose, first to last, nested ones too."""
    transform = env.transform if isinstance(env, TransformedEnv) else env
    if not isinstance(transform, Compose):
        return [transform]
    return [part for inner in transform.transforms for part in flat_transforms(inner)]


def envs_below(env: EnvBase) -> Iterator[EnvBase]:
    """Yield the envs that an env is made of: below its transforms, in a wrapper, of a batch.

    Of a ``SerialEnv`` or ``ParallelEnv`` that is one of each kind. Those of other processes cannot
    be looked at: one is made for that and closed afterwards, as TorchRL does.
    """
    if isinstance(env, TransformedEnv):
        yield env.base_env
    elif isinstance(env, BatchedEnvBase):
        started = vars(env).get("_envs") or []
        seen = set()
        for i, make in enumerate(env.create_env_fn):
            if id(make) in seen:
                continue
            seen.add(id(make))
            one = started[i] if started else make(**env.create_env_kwargs[i])
            yield one
            if not started and not one.is_closed:
                one.close()
    else:
        for part in (*vars(env).get("_modules", {}).values(), *vars(env).values()):
            if isinstance(part, EnvBase):
                yield part


def step_states(env: EnvBase, states: TensorDictBase) -> TensorDictBase:
    """Take a step and return what is written as next, of any number of states if it is stateless.

    ``TransformedEnv.step`` without its checks, and without the shape of the env's own batch.
    """
    if type(env)._step is not TransformedEnv._step:
        return env._step(states)
    inner = env.transform._inv_call(states.copy())
    after = step_states(env.base_env, inner)
    complete_done(env.base_env, after)
    return env.transform._step(inner, after)


def set_states(env: EnvBase, states: TensorDictBase) -> TensorDictBase:
    """Set an env to states; ``env.reset(states, set_state=True)`` without its checks."""
    if type(env)._reset is not TransformedEnv._reset:
        return env._reset(states, set_state=True)
    inner = env.transform._reset_env_preprocess(states.copy())
    shown = set_states(env.base_env, inner)
    complete_done(env.base_env, shown)
    return env.transform._reset(inner, shown)


def complete_done(env: EnvBase, after: TensorDictBase, spec: Composite | None = None) -> None:
    """Write the done entries that an env left out, as TorchRL's ``step`` does; in place.

    ``spec`` is the env's ``full_done_spec_unbatched``, which takes long to ask for.
    """
    if all(after.get(key, None) is not None for key in env.done_keys):
        return
    spec = env.full_done_spec_unbatched if spec is None else spec
    missing = [key for key in spec.keys(True, True) if after.get(key, None) is None]
    for key in missing:
        *group, last = parts(key)
        other = (*group, {"done": "terminated", "terminated": "done"}.get(last, last))
        value = None if unravel_key(other) in missing else after.get(other)
        if value is None:
            value = spec[key].zero(after.batch_size)
        elif last == "done" and (cut := after.get((*group, "truncated"), None)) is not None:
            value = value | cut
        after.set(key, value)


def known_gamma(env: EnvBase) -> float | None:
    """Return the discount per base step of the outermost options that an env has, or None.

    Raises:
        ValueError: if the envs of a batch have options of several discounts.
    """
    parts = reversed(flat_transforms(env)) if isinstance(env, TransformedEnv) else [env]
    for part in parts:
        gamma = vars(part).get("gamma", getattr(type(part), "gamma", None))
        options = "num_options" in vars(part) or hasattr(type(part), "num_options")
        if isinstance(gamma, (int, float)) and (options or isinstance(part, EnvBase)):
            return float(gamma)
    gammas = sorted({g for g in map(known_gamma, envs_below(env)) if g is not None})
    if len(gammas) > 1:
        raise ValueError(
            f"The envs of this {env_name(env)} have options with different discounts: {gammas}. "
            f"Use one discount, or pass MCTSPlanner(env, gamma={gammas[0]})."
        )
    return gammas[0] if gammas else None


def option_gamma(env: EnvBase, duration_key: NestedKey | None) -> float:
    """Return the discount of an env's options; 0.99 for one that writes no ``duration_key``.

    Raises:
        ValueError: if the env writes durations and none of its parts tells its discount.
    """
    gamma = known_gamma(env)
    if gamma is not None:
        return gamma
    if duration_key is not None:
        raise ValueError(
            f"{env_name(env)} writes {duration_key!r}, the base steps of a step, but no "
            "OptionTransform gives the discount per base step. Pass the discount of its rewards: "
            "MCTSPlanner(env, gamma=0.99)."
        )
    return _DEFAULT_GAMMA
