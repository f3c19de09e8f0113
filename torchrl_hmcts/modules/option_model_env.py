"""A macro environment that is learned: what a planner searches where no simulator can be set.

Letters: *B batch of the tensordict, M recorded starts.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.data import Composite, TensorSpec
from torchrl.envs import EnvBase
from torchrl.envs.model_based import ModelBasedEnvBase

from torchrl_hmcts.checks import real_number
from torchrl_hmcts.modules.option_model import OptionMemory, OptionModel
from torchrl_hmcts.nesting import known_gamma


class OptionModelEnv(ModelBasedEnvBase):
    r"""The macro environment of an :class:`OptionModel`, to plan in.

    A step is what the model predicts: state, discounted reward, base steps and end of an option.
    It is stateless, settable, deterministic and without gradients, and has the specs of the env it
    stands for, so that :class:`~torchrl_hmcts.planners.MCTSPlanner` plans in it as in a simulator.

    Predicted entries are brought into the bounds of their specs, and rounded if they are integer.
    Entries that the model does not predict are carried over, counters grow by the predicted base
    steps. With :math:`u` the disagreement of the members, a step of an ensemble can be handled with
    care,

    .. math:: r = \hat R - \lambda u, \qquad \text{truncated if } u > u_{\max}, \text{ then }
        r \le 0

    so that a planner pays for what the model does not know, or stops there.

    Args:
        model (OptionModel): trained or still in training; its parameters are read live.
        env (EnvBase): the macro env it stands for; only its specs are read.
        counter_keys (sequence of NestedKey): integer state entries that count base steps. Where
            one has a bounded spec, reaching its upper bound is ``truncated``, as a time limit is.
            Default: none.
        min_reward (float): predicted rewards of smaller magnitude are 0: a planner that stops at
            the first reward would stop at noise. Default 0; for a sparse reward of 1 about 0.25.
        disagreement_coeff (float): :math:`\lambda`, reward per unit of disagreement. Default 0.
        max_disagreement (float, optional): :math:`u_{\max}`, in standard deviations of a change.
            Default: none.
        memory (OptionMemory, optional): outcomes that were met while acting, which go before
            predictions. Default: none.
        readout (TensorDictModuleBase, optional): run on every new state, to rewrite entries that
            follow from the predicted ones. Default: none.
        starts (TensorDictBase, optional): recorded states ``[M]`` from which ``reset()`` draws.
            Default: drawn from the specs.
        batch_size (sequence of int): of the specs and of ``reset()``; any other can be stepped.
            Default none.
        seed (int, optional): of the draws of ``reset()``. Default: from torch's global generator.
        device (torch.device, optional): Default: that of ``env``, else CPU.

    Raises:
        ValueError: if a number is out of range, or the env lacks an entry that is predicted,
            counted or read.

    Reference:
        Ending where the ensemble is unsure: Kidambi et al., "MOReL", 2020, arXiv 2005.05951.
        Paying for it: Yu et al., "MOPO", 2020, arXiv 2005.13239.

    Examples:
        >>> from tensordict.nn import TensorDictModule
        >>> from torchrl.envs import TransformedEnv
        >>> from torchrl_hmcts.modules import OptionModel, OptionModelEnv
        >>> from torchrl_hmcts.testing import ChainEnv
        >>> from torchrl_hmcts.transforms import OptionTransform
        >>> worker = TensorDictModule(lambda skill: skill, ["skill"], ["action"])
        >>> real = TransformedEnv(ChainEnv(length=6), OptionTransform(worker, 2, max_steps=2))
        >>> table = lambda out_features: torch.nn.Embedding(2, out_features)
        >>> model = OptionModel(table, ["option"], {"state": ()}, max_duration=2)
        >>> env = OptionModelEnv(model, real)
        >>> env.rollout(3, break_when_any_done=False)["next", "state"].shape
        torch.Size([3])
    """

    _supports_set_state = True

    def __init__(
        self,
        model: OptionModel,
        env: EnvBase,
        *,
        counter_keys: Sequence[NestedKey] = (),
        min_reward: float = 0.0,
        disagreement_coeff: float = 0.0,
        max_disagreement: float | None = None,
        memory: OptionMemory | None = None,
        readout: TensorDictModuleBase | None = None,
        starts: TensorDictBase | None = None,
        batch_size: Sequence[int] = (),
        seed: int | None = None,
        device: torch.device | str | None = None,
    ) -> None:
        owner = "OptionModelEnv"
        min_reward = real_number(owner, "min_reward", min_reward, least=0.0)
        disagreement_coeff = real_number(owner, "disagreement_coeff", disagreement_coeff, least=0.0)
        if max_disagreement is not None:
            real_number(owner, "max_disagreement", max_disagreement, least=0.0)
        if model.num_models == 1 and (max_disagreement is not None or disagreement_coeff):
            raise ValueError(
                "OptionModelEnv needs two or more members to measure their disagreement; the "
                "model has one. Make it with OptionModel(..., num_models=5)."
            )
        device = (env.device or "cpu") if device is None else device
        super().__init__(model, device=device, batch_size=torch.Size(batch_size))
        self.min_reward = min_reward
        self.disagreement_coeff = disagreement_coeff
        self.max_disagreement = max_disagreement
        self.gamma = known_gamma(env)  # for a planner: rewards were summed by it
        self.memory = memory
        self.readout = readout
        self.counter_keys = [unravel_key(key) for key in counter_keys]
        self._copy_specs(env)
        self._check_entries(type(env.base_env if hasattr(env, "base_env") else env).__name__)
        self.starts = None if starts is None else starts.reshape(-1).to(self.device)
        self._generator = torch.Generator()
        self.set_seed(seed)

    @property
    def model(self) -> OptionModel:
        """The option model; TorchRL's name for it is ``world_model``."""
        return self.world_model

    def _copy_specs(self, env: EnvBase) -> None:
        def own(spec: Composite) -> Composite:
            return spec.clone().to(self.device)

        observation = own(env.full_observation_spec_unbatched)
        if "trajectory" in observation.keys():  # the base transitions inside an option
            del observation["trajectory"]
        for key, spec in own(env.full_state_spec_unbatched).items(True, True):
            if key not in observation.keys(True, True):
                observation[key] = spec
        # All that a step reads, and no more: a real env may declare no state, and a planner
        # stores one for every node.
        readers = [r for r in (self.model, self.memory, self.readout) if r is not None]
        keys = [*env.full_state_spec.keys(True, True), *self.counter_keys]
        keys += [key for reader in readers for key in reader.in_keys]
        reads = {unravel_key(key) for key in keys} - {unravel_key(key) for key in env.action_keys}
        state = Composite(device=self.device)
        for key, spec in observation.items(True, True):
            if unravel_key(key) in reads:
                state[key] = spec.clone()
        shape = self.batch_size
        self.state_spec = state.expand(shape)
        self.observation_spec = observation.expand(shape)
        self.action_spec = own(env.full_action_spec_unbatched).expand(shape)
        self.reward_spec = own(env.full_reward_spec_unbatched).expand(shape)
        self.done_spec = own(env.full_done_spec_unbatched).expand(shape)

    def _check_entries(self, name: str) -> None:
        model = self.model
        entries: dict[NestedKey, TensorSpec] = {
            unravel_key(key): spec
            for key, spec in self.full_observation_spec_unbatched.items(True, True)
        }
        known = set(entries) | {unravel_key(key) for key in self.action_keys}
        remembered = [] if self.memory is None else self.memory.in_keys
        for key in (*model.in_keys, *self.counter_keys, *remembered):
            if key not in known:
                raise ValueError(
                    f"The option model reads or writes {key!r}, which {name} does not have. Its "
                    f"entries: {sorted(map(str, known))}."
                )
        for key, shape in model.delta_keys.items():
            if entries[key].shape != torch.Size(shape):
                raise ValueError(
                    f"The option model predicts {key!r} of shape {list(shape)}; in {name} it has "
                    f"{list(entries[key].shape)}. Name that shape in delta_keys."
                )
        if [unravel_key(key) for key in self.reward_keys] != [model.reward_key]:
            raise ValueError(
                f"The option model predicts one reward, {model.reward_key!r}; {name} has "
                f"{list(self.reward_keys)}."
            )
        self._done_leaves = {
            key if isinstance(key, str) else key[-1]: unravel_key(key) for key in self.done_keys
        }
        self._predicted = {
            key: entries[key]
            for key in (*model.delta_keys, *self.counter_keys, model.duration_key)
            if key in entries
        }
        self._bounds = {key: _bounds(spec) for key, spec in self._predicted.items()}
        self._carried = [key for key in entries if key not in self._predicted]
        self._reward_dtype = self.full_reward_spec_unbatched[model.reward_key].dtype

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        model = self.model
        with torch.no_grad():
            predicted = model.predict(tensordict)
            if self.memory is not None:
                predicted = self.memory.recall(tensordict, predicted)
        out = TensorDict({}, batch_size=tensordict.batch_size, device=self.device)
        for key in self._carried:
            out.set(key, tensordict.get(key))
        for key in model.delta_keys:
            out.set(key, self._fit(key, predicted.get(key)))
        duration = predicted.get(model.duration_key).round().to(torch.int64)
        if model.duration_key in self._predicted:
            out.set(model.duration_key, duration.to(self._predicted[model.duration_key].dtype))
        terminated = predicted.get(model.terminated_key)
        truncated = torch.zeros_like(terminated)
        for key in self.counter_keys:
            count = tensordict.get(key)
            count = count + duration.reshape(count.shape).to(count.dtype)
            bounds = self._bounds[key]
            if bounds is not None:
                truncated = truncated | (count >= bounds[1]).reshape(truncated.shape)
            out.set(key, self._fit(key, count))
        reward = predicted.get(model.reward_key)
        if self.min_reward:
            reward = reward.masked_fill(reward.abs() < self.min_reward, 0.0)
        if self.disagreement_coeff:
            reward = reward - self.disagreement_coeff * predicted.get(model.disagreement_key)
        if self.max_disagreement is not None:
            unsure = predicted.get(model.disagreement_key) > self.max_disagreement
            reward = torch.where(unsure, reward.clamp_max(0.0), reward)
            truncated, terminated = truncated | unsure, terminated & ~unsure
        out.set(model.reward_key, reward.to(self._reward_dtype))
        flags = {"terminated": terminated, "truncated": truncated, "done": terminated | truncated}
        for name, key in self._done_leaves.items():
            out.set(key, flags[name])
        return out if self.readout is None else self.readout(out)

    def _fit(self, key: NestedKey, value: Tensor) -> Tensor:
        """Bring a predicted entry into the form and the bounds of its spec."""
        dtype, bounds = self._predicted[key].dtype, self._bounds[key]
        if not dtype.is_floating_point and value.is_floating_point():
            value = value.round()
        if bounds is not None:
            value = torch.minimum(torch.maximum(value, bounds[0]), bounds[1])
        return value.to(dtype)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        keys = list(self.full_observation_spec.keys(True, True))
        given = TensorDict(batch_size=self.batch_size) if tensordict is None else tensordict
        shape = given.batch_size
        zero = self.full_observation_spec_unbatched.zero(shape)
        if kwargs.get("set_state"):
            needed = self.full_state_spec.keys(True, True)
            missing = [key for key in needed if given.get(key, None) is None]
            if missing:
                raise ValueError(
                    f"reset(td, set_state=True) needs the whole state in td; missing: {missing}. "
                    f'Pass a tensordict as the real env\'s reset() or step(td)["next"] gives it.'
                )
            return zero.update(given.select(*keys, strict=False))
        if self.starts is not None:
            rows = torch.randint(len(self.starts), shape, generator=self._generator)
            return zero.update(self.starts[rows.to(self.device)].select(*keys, strict=False))
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(int(torch.randint(2**31, (), generator=self._generator)))
            drawn = self.full_observation_spec_unbatched.rand(shape)
        counted = [key for key in self._predicted if key not in self.model.delta_keys]
        return drawn.update(zero.select(*counted))

    def _set_seed(self, seed: int | None) -> None:
        drawn = torch.empty((), dtype=torch.int64).random_() if seed is None else seed
        self._generator.manual_seed(int(drawn))


def _bounds(spec: TensorSpec) -> tuple[Tensor, Tensor] | None:
    """Lowest and highest values of a bounded or categorical spec; None of any other."""
    space = spec.space
    if hasattr(space, "low") and hasattr(space, "high"):
        return space.low, space.high
    if hasattr(space, "n"):
        zero = torch.zeros((), dtype=spec.dtype, device=spec.device)
        return zero, zero + (int(space.n) - 1)
    return None
