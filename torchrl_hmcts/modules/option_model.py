"""A learned model of options, and a memory of what they really led to where the model errs.

Letters: *B batch of the tensordict, m rows, K members of the ensemble, C contexts, N outcomes kept
of each, D predicted state numbers in all, f numbers compared.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping, Sequence

import torch
from tensordict import TensorDict, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase, TensorDictParams
from tensordict.utils import NestedKey
from torch import Tensor, nn

from torchrl_hmcts.checks import real_number
from torchrl_hmcts.modules.skill_mlp import check_sizes, key_list


class OptionModel(TensorDictModuleBase):
    r"""Predicts the outcome of an option: the model of an SMDP, as an ensemble of networks.

    From state :math:`s` and option :math:`o`, each member predicts the change of some state
    entries, the discounted reward, the base steps taken, and how likely the episode ends by itself:

    .. math:: \hat s' = s + \mu + \sigma f_s(s, o), \quad \hat R(s, o), \quad \hat k(s, o), \quad
        \hat p(s, o) = \operatorname{sigmoid} f_p(s, o)

    with :math:`\mu, \sigma` mean and standard deviation in the data (:meth:`fit_normalization`).
    What is written is the mean over the members; their disagreement about :math:`s'` tells where
    data were missing. An :class:`OptionModelEnv` carries over what ``delta_keys`` do not name.

    Args:
        make_network (callable): ``make_network(out_features) -> nn.Module``, called once for each
            member. The module is called with the entries ``in_keys`` in order and returns ``[*B,
            out_features]``, with ``out_features`` = D + 3. Members are alike and run as one.
        in_keys (sequence of NestedKey): entries the networks read, the option among them if it is
            one of their inputs.
        delta_keys (mapping): the state entries that are predicted, and the shape of each without
            the batch (an int for one dimension), e.g. ``{"position": 2, "velocity": 2}``. Integer
            entries are predicted as real numbers.
        max_duration (int): base steps an option takes at most; predictions lie in 1 to this.
        num_models (int): members of the ensemble, K. Default 1: no disagreement is known.
        features (TensorDictModuleBase, optional): run before the networks, once for all members;
            what it writes can be named in ``in_keys``. Default: none.
        reward_key, duration_key, terminated_key (NestedKey): names of the outcomes, under
            ``"next"``. Defaults ``"reward"``, ``"duration"``, ``"terminated"``.

    Writes (under ``"next"``): the predicted state entries; the reward and the duration (float
    ``[*B, 1]``, base steps); terminated (bool ``[*B, 1]``, probability above one half);
    ``"terminated_probability"`` and ``"disagreement"`` (float ``[*B, 1]``: standard deviation over
    the members, in units of :math:`\sigma`, root of the mean square over the D numbers).

    Raises:
        ValueError: if a number is not positive, no key is given, or the members differ in their
            parameters.

    Reference:
        Models of options: Sutton, Precup and Singh, "Between MDPs and semi-MDPs", 1999, section 3.
        Ensembles: Chua et al., "Deep Reinforcement Learning in a Handful of Trials using
        Probabilistic Dynamics Models", 2018, arXiv 1805.12114.

    Examples:
        >>> from torchrl_hmcts.modules import OptionModel, SkillMLP
        >>> model = OptionModel(lambda n: SkillMLP(2, n, num_skills=4), ["position", "option"],
        ...                     {"position": 2}, max_duration=25, num_models=3)
        >>> td = TensorDict(position=torch.zeros(5, 2), option=torch.zeros(5, dtype=torch.int64),
        ...                 batch_size=[5])
        >>> td = model(td)
        >>> td["next", "position"].shape, td["next", "duration"].shape
        (torch.Size([5, 2]), torch.Size([5, 1]))
    """

    probability_key, disagreement_key = "terminated_probability", "disagreement"
    output_mean: Tensor
    output_scale: Tensor

    def __init__(
        self,
        make_network: Callable[[int], nn.Module],
        in_keys: Sequence[NestedKey],
        delta_keys: Mapping[NestedKey, int | Sequence[int]],
        *,
        max_duration: int,
        num_models: int = 1,
        features: TensorDictModuleBase | None = None,
        reward_key: NestedKey = "reward",
        duration_key: NestedKey = "duration",
        terminated_key: NestedKey = "terminated",
    ) -> None:
        super().__init__()
        check_sizes("OptionModel", max_duration=max_duration, num_models=num_models)
        if num_models > 1_000:
            raise ValueError(f"OptionModel needs num_models <= 1,000; got {num_models}.")
        if not delta_keys:
            raise ValueError(
                "OptionModel needs the state entries that an option changes; delta_keys is empty. "
                'Pass e.g. delta_keys={"position": 2}.'
            )
        self.network_keys = key_list("OptionModel", in_keys)
        self.delta_keys: dict[NestedKey, tuple[int, ...]] = {
            unravel_key(key): (shape,) if isinstance(shape, int) else tuple(shape)
            for key, shape in delta_keys.items()
        }
        self.num_deltas = sum(math.prod(shape) for shape in self.delta_keys.values())
        self.num_models = num_models
        self.max_duration = max_duration
        self.reward_key = unravel_key(reward_key)
        self.duration_key = unravel_key(duration_key)
        self.terminated_key = unravel_key(terminated_key)
        self.features = features
        read = [] if features is None else [unravel_key(key) for key in features.in_keys]
        made = [] if features is None else [unravel_key(key) for key in features.out_keys]
        read += [key for key in self.network_keys if key not in made]
        self.in_keys = list(dict.fromkeys([*read, *self.delta_keys]))
        outcome = [self.reward_key, self.duration_key, self.terminated_key]
        written = [*self.delta_keys, *outcome, self.probability_key, self.disagreement_key]
        self.out_keys = [unravel_key(("next", key)) for key in written]
        networks = [make_network(self.num_deltas + 3) for _ in range(num_models)]
        if len({id(network) for network in networks}) < num_models:
            raise ValueError("OptionModel needs a make_network that builds a new one at each call.")
        try:
            self.network_params = TensorDictParams(TensorDict.from_modules(*networks))
        except (RuntimeError, KeyError) as error:
            raise ValueError(
                "OptionModel stacks the parameters of its members, so make_network must build them "
                f"alike: {error}"
            ) from error
        # Not a sub-module: it lends its structure, the parameters are put in stacked.
        self.__dict__["network"] = networks[0]
        # Of changes, reward and duration; the change of nothing is known until there are data.
        self.register_buffer("output_mean", torch.zeros(self.num_deltas + 2))
        self.register_buffer("output_scale", torch.ones(self.num_deltas + 2))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the predicted outcome of each row's option under ``"next"``."""
        predicted = self.predict(tensordict)
        after = tensordict.get("next", None)
        return tensordict.set("next", predicted if after is None else after.update(predicted))

    def predict(self, tensordict: TensorDictBase) -> TensorDict:
        """Predict outcomes as :meth:`forward` writes them, without its ``"next"``."""
        members = self.outputs(tensordict)  # [K, *B, D + 3]
        mean, size = members.mean(0), self.num_deltas
        probability = members[..., -1:].sigmoid().mean(0)
        values = mean[..., :-1] * self.output_scale + self.output_mean
        if self.num_models > 1:
            spread = members[..., :size].std(0, correction=0)
            disagreement = spread.square().mean(-1, keepdim=True).sqrt()
        else:
            disagreement = torch.zeros_like(probability)
        out = TensorDict({}, batch_size=tensordict.batch_size, device=tensordict.device)
        for key, value in self.changed(tensordict, values[..., :size]).items():
            out.set(key, value)
        out.set(self.reward_key, values[..., size : size + 1])
        out.set(self.duration_key, values[..., size + 1 :].clamp(1.0, float(self.max_duration)))
        out.set(self.terminated_key, probability > 0.5)
        out.set(self.probability_key, probability)
        out.set(self.disagreement_key, disagreement)
        return out

    def outputs(self, tensordict: TensorDictBase) -> Tensor:
        """Return the outputs of the networks, ``[K, *B, D + 3]``.

        Normalised changes, reward and duration, then the logit of an end of the episode.
        """
        td = tensordict
        if self.features is not None:
            made = self.features(td.select(*self.features.in_keys))
            td = td.copy().update(made)
        inputs = [td.get(key) for key in self.network_keys]
        if self.num_models == 1:
            outputs: Tensor = self._run(self.network_params[0], *inputs).unsqueeze(0)
        else:
            params = self.network_params
            if torch.compiler.is_compiling():  # of locked ones in a graph tensordict warns
                params = TensorDict(dict(params.items(True, True)), batch_size=params.batch_size)
            in_dims = (0, *[None] * len(inputs))
            outputs = torch.vmap(self._run, in_dims, randomness="different")(params, *inputs)
        shape = (self.num_models, *tensordict.batch_size, self.num_deltas + 3)
        if outputs.shape != torch.Size(shape):
            raise ValueError(
                f"The networks of OptionModel must return {list(shape[1:])} for a batch "
                f"{list(tensordict.batch_size)}; got {list(outputs.shape[1:])}. Their last layer "
                f"needs the out_features that make_network is called with."
            )
        return outputs

    def _run(self, params: TensorDictBase, *inputs: Tensor) -> Tensor:
        with params.to_module(self.network):
            out: Tensor = self.network(*inputs)
        return out

    def targets(
        self,
        tensordict: TensorDictBase,
        *,
        reward_key: NestedKey | None = None,
        duration_key: NestedKey | None = None,
        terminated_key: NestedKey | None = None,
        normalized: bool = True,
    ) -> Tensor:
        """Return the targets of :meth:`outputs` for recorded transitions, ``[*B, D + 3]``.

        Keys default to the model's; ``normalized`` subtracts the mean and divides by the scale.
        """
        after = tensordict.get("next")
        parts = [after.get(key) - tensordict.get(key) for key in self.delta_keys]
        parts.append(after.get(reward_key or self.reward_key))
        parts.append(after.get(duration_key or self.duration_key))
        parts.append(after.get(terminated_key or self.terminated_key))
        rows = [part.reshape((*tensordict.batch_size, -1)).to(self.output_mean) for part in parts]
        values, terminated = torch.cat(rows[:-1], -1), rows[-1]
        if normalized:
            values = (values - self.output_mean) / self.output_scale
        return torch.cat((values, terminated), -1)

    def changed(self, tensordict: TensorDictBase, deltas: Tensor) -> dict[NestedKey, Tensor]:
        """Return the predicted state entries after changes ``[*B, D]``."""
        shape, begin, entries = tensordict.batch_size, 0, {}
        for key, event in self.delta_keys.items():
            end = begin + math.prod(event)
            entries[key] = tensordict.get(key) + deltas[..., begin:end].reshape((*shape, *event))
            begin = end
        return entries

    @torch.no_grad()
    def fit_normalization(self, tensordict: TensorDictBase) -> OptionModel:
        """Take mean and standard deviation of the outputs from recorded transitions ``[*B]``.

        An output that never varies keeps scale 1. Call it before training: the meaning of the
        networks' outputs changes with it.
        """
        values = self.targets(tensordict, normalized=False).flatten(0, -2)
        deltas, rest = values[:, : self.num_deltas], values[:, self.num_deltas : -1]
        empty = (values[:, -1] > 0.5) & ~deltas.isfinite().all(-1)  # a terminal state may be
        deltas = deltas[~empty]
        if len(deltas) < 2:
            raise ValueError(
                f"fit_normalization needs at least 2 transitions; got {len(deltas)}. Record some "
                f"with a TorchRL collector over the macro env."
            )
        scale = torch.cat([part.std(0) for part in (deltas, rest)])
        self.output_mean.copy_(torch.cat([part.mean(0) for part in (deltas, rest)]))
        self.output_scale.copy_(torch.where(scale > 1e-6, scale, 1.0))
        return self

    def member(self, index: int) -> OptionModel:
        """Return a copy with one member only, to measure the worth of the ensemble."""

        model = copy.deepcopy(self)
        model.num_models = 1
        params = self.network_params[index].detach().clone()
        model.network_params = TensorDictParams(params.unsqueeze(0))
        return model


class OptionMemory:
    r"""Replaces a prediction by an observed outcome of the same option from nearly the same state.

    With :math:`\phi` the entries ``keys`` side by side and :math:`(s_i, o_i)` the options executed
    in the same context, a prediction for :math:`(s, o)` gives way to outcome :math:`i` if

    .. math:: o_i = o, \qquad i = \arg\min_j \lVert \phi(s) - \phi(s_j) \rVert, \qquad
        \lVert \phi(s) - \phi(s_i) \rVert \le r

    A plan that failed because the model erred is else made again and again from the same state.
    State entries change by what they changed then.

    Args:
        model (OptionModel): whose predictions are replaced.
        keys (sequence of NestedKey): entries that are compared, those on which an outcome depends.
        radius (float): r, in units of the entries.
        num_contexts (int): C, e.g. the number of mazes.
        context_key (NestedKey): index of the context, int64 ``[*B]``, e.g. ``"maze_index"``.
        option_key (NestedKey): int64 ``[*B]``. Default ``"option"``.
        capacity (int): N; the oldest outcome makes room. Default 64.

    Raises:
        ValueError: if a number is not positive.

    Reference:
        Outcomes kept as they were, for cases that return: Lengyel and Dayan, "Hippocampal
        Contributions to Control: The Third Way", 2007.

    Examples:
        >>> from torchrl_hmcts.modules import OptionMemory, OptionModel, SkillMLP
        >>> model = OptionModel(lambda n: SkillMLP(1, n, num_skills=2), ["place", "option"],
        ...                     {"place": 1}, max_duration=9)
        >>> memory = OptionMemory(model, ["place"], 0.1, num_contexts=1, context_key="maze")
        >>> td = TensorDict(place=torch.zeros(1, 1), option=torch.tensor([1]),
        ...                 maze=torch.tensor([0]), batch_size=[1])
        >>> after = TensorDict(place=torch.ones(1, 1), reward=torch.zeros(1, 1),
        ...                    duration=torch.full((1, 1), 9),
        ...                    terminated=torch.zeros(1, 1, dtype=torch.bool), batch_size=[1])
        >>> memory.remember(td.clone().set("next", after))
        >>> memory.recall(td, model.predict(td))["place"].tolist()
        [[1.0]]
    """

    def __init__(
        self,
        model: OptionModel,
        keys: Sequence[NestedKey],
        radius: float,
        *,
        num_contexts: int,
        context_key: NestedKey,
        option_key: NestedKey = "option",
        capacity: int = 64,
    ) -> None:
        check_sizes("OptionMemory", num_contexts=num_contexts, capacity=capacity)
        self.model = model
        self.keys = key_list("OptionMemory", keys)
        self.radius = real_number("OptionMemory", "radius", radius, above=0.0)
        self.context_key = unravel_key(context_key)
        self.option_key = unravel_key(option_key)
        self.in_keys = [*self.keys, self.context_key, self.option_key]
        self.capacity = capacity
        self.num_contexts = num_contexts
        self.clear()

    def clear(self) -> None:
        """Forget everything."""
        self._count = torch.zeros(self.num_contexts, dtype=torch.int64)
        self._option = torch.full((self.num_contexts, self.capacity), -1)
        self._place: Tensor | None = None  # [C, N, f]
        self._outcome: Tensor | None = None  # [C, N, D + 3]

    def remember(self, tensordict: TensorDictBase) -> None:
        """Keep the outcomes of transitions ``[*B]``; padding (``"_step"`` False) is left out."""
        td = tensordict.reshape(-1)
        stepped = td.get("_step", None)
        if stepped is not None:
            td = td[stepped.reshape(-1)]
        if not len(td):
            return
        place, outcome = self._places(td), self.model.targets(td, normalized=False)
        if self._place is None or self._outcome is None:
            shape = (self.num_contexts, self.capacity)
            self._option = self._option.to(place.device)
            self._place = place.new_zeros(*shape, place.shape[-1])
            self._outcome = outcome.new_zeros(*shape, outcome.shape[-1])
        options = td.get(self.option_key)
        for row, context in enumerate(td.get(self.context_key).tolist()):
            slot = int(self._count[context]) % self.capacity
            self._option[context, slot] = options[row]
            self._place[context, slot] = place[row]
            self._outcome[context, slot] = outcome[row]
            self._count[context] += 1

    def recall(self, tensordict: TensorDictBase, predicted: TensorDict) -> TensorDict:
        """Return predictions ``[*B]``, replaced where an outcome is remembered."""
        if self._place is None or self._outcome is None:
            return predicted
        td = tensordict.reshape(-1)
        context = td.get(self.context_key)
        distance = (self._place[context] - self._places(td).unsqueeze(1)).norm(dim=-1)  # [m, N]
        other = self._option[context] != td.get(self.option_key).unsqueeze(-1)
        nearest, slot = distance.masked_fill(other, torch.inf).min(-1)
        known = nearest <= self.radius
        if not known.any():
            return predicted
        outcome = self._outcome[context[known], slot[known]]
        replaced: TensorDict = predicted.reshape(-1).clone()
        model, (reward, duration, ended) = self.model, outcome[:, -3:].split(1, -1)
        known_values = {
            **model.changed(td[known], outcome[:, :-3]),
            model.reward_key: reward,
            model.duration_key: duration,
            model.probability_key: ended,
            model.terminated_key: ended > 0.5,
            model.disagreement_key: torch.zeros_like(ended),
        }
        for key, value in known_values.items():
            entry = replaced.get(key)
            entry[known] = value.to(entry.dtype)
        return replaced.reshape(predicted.batch_size)

    def _places(self, td: TensorDictBase) -> Tensor:
        return torch.cat([td.get(key).reshape(len(td), -1).float() for key in self.keys], -1)
