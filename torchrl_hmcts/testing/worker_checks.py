"""Checks of workers: what acts inside an option, what ends it, what makes its skills.

Letters: *B batch of a tensordict, A options, Z skills.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.utils import step_mdp

from torchrl_hmcts.modules.skill_prior import SkillPrior
from torchrl_hmcts.objectives.skill_objective import SkillObjective
from torchrl_hmcts.testing.contract import (
    asked,
    during,
    leaves,
    require,
    require_action,
    require_alone,
    require_kind,
    require_read,
    require_same,
    seeded,
)
from torchrl_hmcts.testing.loss_checks import MakeLoss, check_loss
from torchrl_hmcts.transforms.option import OptionTransform
from torchrl_hmcts.transforms.trajectory import OptionTrajectory


def check_worker(
    worker: Callable[[TensorDictBase], TensorDictBase],
    env: EnvBase,
    num_options: int,
    *,
    skill_key: NestedKey = "skill",
    deterministic: bool = True,
    tolerance: float = 1e-6,
) -> None:
    """Check that a worker can execute options in an env.

    It reads what the env has and writes actions of its spec, for every option; it changes nothing
    else of its input and leaves its own parameters alone; it takes any batch shape, and what it
    does in one element depends on that element only: a planner runs it on all elements at once, and
    the env on one.

    Args:
        worker (callable): a TensorDictModule that reads entries of the env and ``skill_key``, and
            writes the env's action.
        env (EnvBase): the env it acts in, without the
            :class:`~torchrl_hmcts.transforms.OptionTransform`. If it is stateless (``batch_locked``
            is False) batches are tried.
        num_options (int): A, the options it knows.
        skill_key (NestedKey): from which it reads its option, int64 ``[*B]``. Default ``"skill"``.
        deterministic (bool): whether state and option decide the action. Default ``True``; with
            ``False`` the same seed must give the same action.
        tolerance (float): difference between a float action alone and among others that is allowed,
            relative and absolute; discrete actions must agree. Default 1e-6.

    Raises:
        ContractError: if it cannot.

    Examples:
        >>> from tensordict.nn import TensorDictModule
        >>> from torchrl_hmcts.testing import ChainEnv, check_worker
        >>> worker = TensorDictModule(lambda skill: skill, ["skill"], ["action"])
        >>> check_worker(worker, ChainEnv(), num_options=2)
    """
    name = type(worker).__name__
    with during(name, "as the worker of an OptionTransform"):
        transform = OptionTransform(worker, num_options, 1, skill_key=skill_key)
        TransformedEnv(env, transform, auto_unwrap=False)
    states = _states(env, num_options)
    options = torch.arange(states.batch_size.numel()).reshape(states.batch_size) % num_options
    given = states.clone().set(skill_key, options.to(states.device or "cpu"))
    weights = _weights(worker)
    keys = set(map(unravel_key, env.action_keys))
    random = (
        "Read nothing of other elements (no batch statistics), and draw random numbers from "
        "torch's generator or your own, seeded; for a random worker pass deterministic=False."
    )
    for td in [given] if env.batch_locked else [given, given.reshape(2, -1), given[:1]]:
        out = _act(name, worker, td)
        require_action(name, env, out)
        message = "changed <key> of its input. A worker writes actions; the env writes the rest."
        require_same(td, out, f"{name} {message}")
        message = f"the actions of two calls with the same seed differ in <key>. {random}"
        require_same(out, _act(name, worker, td), f"{name}: {message}", keys)
    for key, now in _weights(worker).items():
        require(
            torch.equal(weights[key], now),
            f"{name} changed its own {key!r} while acting. Call eval() first, or keep running "
            "statistics out of it.",
        )
    _check_option(name, worker, env, num_options, skill_key)
    if deterministic and not env.batch_locked:
        together = _act(name, worker, given)
        for b, option in enumerate(options.tolist()):
            message = (
                f"the actions of an element alone and among others (option {option}) differ: "
                f"<other> and <one>. {random}"
            )
            alone = _act(name, worker, given[b])
            require_same(together[b], alone, f"{name}: {message}", keys, tolerance)


def _check_option(
    name: str,
    worker: Callable[[TensorDictBase], TensorDictBase],
    env: EnvBase,
    num_options: int,
    skill_key: NestedKey,
    num_steps: int = 5,
) -> None:
    """Compare the actions of an option with those of a plain rollout."""
    keys = [unravel_key(key) for key in env.action_keys]
    options = OptionTransform(
        worker,
        num_options,
        num_steps,
        option_key="_checked_option",
        skill_key=skill_key,
        trajectory_keys=keys,
    )
    macro = TransformedEnv(env, options, auto_unwrap=False)
    with during(name, "executing an option"), torch.no_grad():
        with seeded(0):
            env.set_seed(0)
            td = macro.reset()
            option = torch.full(td.batch_size, num_options - 1, device=td.device)
            block = macro.step(td.set("_checked_option", option))["next", OptionTrajectory.KEY]
        with seeded(0):
            env.set_seed(0)
            td = env.reset()
            for i in range(num_steps):
                worker(td.set(skill_key, option))
                td, step = env.step(td), block[..., i]
                ran = step.get(OptionTrajectory.MASK_KEY)
                require_same(
                    td.select(*keys)[ran],
                    step.select(*keys)[ran],
                    f"{name} writes <key> = <other> in base step {i} of an option and <one> in a "
                    "plain rollout: its memory is lost. Let it write under 'next' what it reads in "
                    "the next step, and keep nothing in itself.",
                    tolerance=1e-5,
                )
                if not block.get(OptionTrajectory.MASK_KEY)[..., i + 1 :].any():
                    return
                td = step_mdp(td)


def _states(env: EnvBase, num_options: int) -> TensorDictBase:
    """Return roots; of a stateless env a batch, after three random steps."""
    with seeded(0):
        env.set_seed(0)
        if env.batch_locked or env.batch_size:
            td = env.reset()
        else:
            td = env.reset(TensorDict(batch_size=[2 * num_options]))
            for _ in range(3):
                _, td = env.step_and_maybe_reset(env.rand_action(td))
    return td.exclude("next", *env.action_keys)


def _weights(worker: object) -> dict[str, Tensor]:
    if not isinstance(worker, torch.nn.Module):
        return {}
    state = worker.state_dict()
    return {key: value.clone() for key, value in state.items() if isinstance(value, Tensor)}


def _act(
    name: str, worker: Callable[[TensorDictBase], TensorDictBase], td: TensorDictBase
) -> TensorDictBase:
    td = td.clone()
    where = f"acting for a batch of shape {list(td.batch_size)}"
    with during(name, where, "A worker takes tensordicts of any batch shape."):
        with torch.no_grad(), seeded(0):
            out = worker(td)
    return td if out is None else out


def check_termination(
    termination: Callable[[TensorDictBase], Tensor],
    tensordict: TensorDictBase,
    *,
    deterministic: bool = True,
) -> None:
    """Check that a condition can end options.

    It gives one bool per element, for any batch shape, leaves its input as it was, and asks of an
    element nothing about the others.

    Args:
        termination (callable): ``termination(td) -> bool [*B]`` or ``[*B, 1]``, as
            :class:`~torchrl_hmcts.transforms.OptionTransform` takes it.
        tensordict (TensorDictBase): entries after a base step, ``[m]``, with the option under its
            ``skill_key`` and the base steps taken under ``"duration"``; of some variety.
        deterministic (bool): whether it draws no random numbers. Default ``True``.

    Raises:
        ValueError: if ``tensordict`` holds no elements, or more than one batch dimension.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_hmcts.modules import StallTermination
        >>> from torchrl_hmcts.testing import check_termination
        >>> td = TensorDict(stalled_steps=torch.tensor([[1], [3]]),
        ...                 duration=torch.tensor([[9], [9]]), batch_size=[2])
        >>> check_termination(StallTermination(3), td)
    """
    name = getattr(termination, "__name__", type(termination).__name__)
    if len(tensordict.batch_size) != 1 or not len(tensordict):
        raise ValueError(
            f"check_termination needs a tensordict [m] of states; got batch size "
            f"{list(tensordict.batch_size)}."
        )
    require_read(name, termination, tensordict, "the tensordict")
    m = len(tensordict)

    def ask(td: TensorDictBase) -> Tensor:
        doing = f"asked about a batch of shape {list(td.batch_size)}"
        return asked(name, termination, td, doing)

    for td in (tensordict, tensordict.reshape(1, m)):
        shape, ends = td.batch_size, ask(td)
        got = f"{ends.dtype} {list(ends.shape)}" if isinstance(ends, Tensor) else repr(ends)
        require(
            got in (f"torch.bool {list(shape)}", f"torch.bool {[*shape, 1]}"),
            f"{name} must give bool {list(shape)} or {[*shape, 1]}, True where the option ends; "
            f"got {got}.",
        )
    if deterministic:
        require_alone(
            name,
            lambda row: ask(row).reshape(-1),
            tensordict,
            ask(tensordict).reshape(-1),
            "element",
            "Ask about each element by itself; for a random condition pass deterministic=False.",
        )


def check_skill_objective(
    make_objective: MakeLoss, tensordict: TensorDictBase, **kwargs: Any
) -> None:
    """Check that an objective of skill discovery can take the place of another.

    All of :func:`check_loss`, and of its reward: one finite number ``[*B, 1]`` per transition,
    without a gradient, which depends on that transition only, and which a reward transform can ask
    for without the tensordict being changed.

    Args:
        make_objective (callable): ``make_objective(name, **kwargs) -> SkillObjective``, as
            ``make_loss`` of :func:`check_loss`.
        tensordict (TensorDictBase): transitions ``[n]`` with the objective's ``in_keys``.
        **kwargs: of :func:`check_loss`.

    Raises:
        ContractError: if it cannot.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_hmcts.modules import SkillEncoder
        >>> from torchrl_hmcts.objectives import METRAEncoderLoss
        >>> from torchrl_hmcts.testing import check_skill_objective
        >>> def make_objective(name, **kwargs):
        ...     encoder = SkillEncoder(2, num_skills=3, in_keys=[name("x")],
        ...                            representation_key=name("representation"))
        ...     return METRAEncoderLoss(encoder, **kwargs)
        >>> td = TensorDict(x=torch.randn(3, 2), skill=torch.arange(3),
        ...                 next=TensorDict(x=torch.randn(3, 2), batch_size=[3]), batch_size=[3])
        >>> check_skill_objective(make_objective, td, checks=["out_keys", "reduction"])
    """
    with seeded(0):
        objective = make_objective(lambda key: key)
    name = require_kind(objective, SkillObjective)

    def ask(transitions: TensorDictBase) -> Tensor:
        with during(name, "asked for the reward"), seeded(0):
            return objective.reward(transitions)

    given, shape = tensordict.clone(), [*tensordict.batch_size, 1]
    reward = ask(given)
    require(
        list(reward.shape) == shape,
        f"{name}.reward gives {list(reward.shape)} for transitions {shape[:-1]}; it must give "
        f"{shape}.",
    )
    require(
        not reward.requires_grad,
        f"{name}.reward has a gradient. Decorate it with torch.no_grad().",
    )
    require(
        torch.isfinite(reward).all(), f"{name}.reward gives {reward!s:.200}, which is not finite."
    )
    require(
        leaves(given) == leaves(tensordict),
        f"{name}.reward wrote {sorted(map(str, leaves(given) ^ leaves(tensordict)))} into the "
        "transitions. Select what it reads.",
    )
    require_alone(f"{name}.reward", lambda row: ask(row.clone()), tensordict, reward, "transition")
    check_loss(make_objective, tensordict, **kwargs)


def check_skill_prior(prior: SkillPrior) -> None:
    """Check that a skill prior is a distribution over skills.

    ``probs()`` is not negative and sums to 1; ``log_probs()`` and ``active()`` say the same;
    nothing of it is drawn at random; it survives its state dict.

    Args:
        prior (SkillPrior): the prior.

    Raises:
        ContractError: if it is not.

    Examples:
        >>> from torchrl_hmcts.modules import GrowingSkillPrior
        >>> from torchrl_hmcts.testing import check_skill_prior
        >>> check_skill_prior(GrowingSkillPrior(4, num_active=2))
    """
    name = require_kind(prior, SkillPrior)
    with during(name, "asked for its probabilities"), torch.no_grad():
        probs, log_probs, active = prior.probs(), prior.log_probs(), prior.active()
    require(
        probs.shape == torch.Size([prior.num_skills]),
        f"{name}: probs() gives {list(probs.shape)}; it must give [{prior.num_skills}], one per "
        "skill.",
    )
    require((probs >= 0).all(), f"{name}: probs() gives {probs.min().item():g}, below 0.")
    total = probs.sum().item()
    require(
        abs(total - 1.0) < 1e-5, f"{name}: probs() sums to {total:g}, not 1. Divide by the sum."
    )
    require(
        active.dtype == torch.bool and torch.equal(active, probs > 0),
        f"{name}: active() gives {active.tolist()} where probs() gives {probs.tolist()}. A skill "
        "is on where its probability is not 0.",
    )
    require(
        torch.allclose(log_probs.exp(), probs, atol=1e-6),
        f"{name}: log_probs() is not the logarithm of probs().",
    )
    with torch.no_grad():
        require(
            torch.equal(prior.probs(), probs),
            f"{name}: probs() gives another distribution at its second call. Change the "
            "distribution only in methods made for that.",
        )
