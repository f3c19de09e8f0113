"""Training a skill objective beside actor and critics."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictParams, dispatch
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.objectives.utils import ValueEstimators, distance_loss

from torchrl_hmcts.objectives.functional import (
    run_network,
    takes_weights,
    without_terminal_entries,
)
from torchrl_hmcts.objectives.priority import PriorityWeights
from torchrl_hmcts.objectives.skill_objective import SkillObjective, check_reduction


class TrainsObjective(PriorityWeights):
    """What the discrete and the continuous loss share: they train a SkillObjective as well."""

    objective: SkillObjective
    _in_keys: Any  # list of keys, or None until it is known

    @staticmethod
    def _check(
        owner: str,
        objective: SkillObjective,
        reduction: str | None,
        gamma: float,
        alpha_init: float,
    ) -> str:
        """Checks the arguments that TorchRL does not, and returns the reduction."""
        if not isinstance(objective, SkillObjective):
            raise TypeError(
                f"{owner} trains a SkillObjective beside actor and critics; got "
                f"{type(objective).__name__}. Pass e.g. SkillDiscriminatorLoss(discriminator)."
            )
        if reduction is None:
            reduction = objective.reduction
        check_reduction(owner, reduction)
        if reduction != objective.reduction:
            raise ValueError(
                f"{owner} reduces by {reduction!r}, but its {type(objective).__name__} by "
                f"{objective.reduction!r}. Build both with the same reduction."
            )
        if not 0.0 <= gamma <= 1.0:
            raise ValueError(f"{owner} needs a discount gamma between 0 and 1; got {gamma}.")
        if alpha_init <= 0.0:
            raise ValueError(
                f"{owner} keeps the logarithm of alpha, so alpha_init must be positive; got "
                f"{alpha_init}. Pass e.g. alpha_init=1e-3 for next to no entropy bonus."
            )
        return reduction

    def _attach(self, objective: SkillObjective, gamma: float) -> None:
        self.objective = objective
        for name in self._shared_keys():
            setattr(self.tensor_keys, name, getattr(objective.tensor_keys, name))
        # Eagerly: a value estimator built at the first call would add entries to the state dict.
        self.make_value_estimator(ValueEstimators.TD0, gamma=gamma)
        diagnostics = [f"qvalue_loss_{i}" for i in range(self.num_qvalue_nets)]
        diagnostics += [key for key in objective.out_keys if not key.startswith("loss")]
        if self.reduction != "none":
            diagnostics += ["alpha", "entropy"]
        losses = [key for key in objective.out_keys if key.startswith("loss")]
        self.out_keys = ["loss_actor", "loss_qvalue", "loss_alpha", *losses, *diagnostics]
        self._set_in_keys()

    def _shared_keys(self) -> set[str]:
        """Returns the names of keys that the objective reads under the same name."""
        if "objective" not in self._modules:
            return set()
        own, other = self._AcceptedKeys, self.objective._AcceptedKeys
        return set(own.__dataclass_fields__) & set(other.__dataclass_fields__)

    def _forward_value_estimator_keys(self, **kwargs: NestedKey) -> None:
        shared = {k: getattr(self.tensor_keys, k) for k in self._shared_keys() & set(kwargs)}
        if shared:
            self.objective.set_keys(**shared)
        super()._forward_value_estimator_keys(**kwargs)

    def _set_in_keys(self) -> None:
        super()._set_in_keys()
        if "objective" not in self._modules:
            return
        # The parent forgets what the critics read of the next state, and nests tuples in tuples.
        action = unravel_key(self.tensor_keys.action)
        critic = [("next", k) for k in self.qvalue_network.in_keys if unravel_key(k) != action]
        keys = [*self._in_keys, *critic, *self.objective.in_keys]
        self._in_keys = sorted({unravel_key(key) for key in keys}, key=str)

    def _make_vmap(self) -> None:
        super()._make_vmap()
        if takes_weights(self.qvalue_network):
            # Such a critic runs on the stacked parameters of all copies at once: a vmap or a loop
            # over them takes twice as long.
            self._vmap_qnetworkN0 = self._stacked_qnetwork

    def _stacked_qnetwork(
        self, tensordict: TensorDictBase, params: TensorDictParams
    ) -> TensorDictBase:
        """Returns what N critics write, with N as the first dimension."""
        value = run_network(self.qvalue_network, params, tensordict)
        return TensorDict({self.qvalue_network.out_key: value}, batch_size=value.shape[:-1])

    def _what_follows(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Returns the entries after transitions, in a copy, without those of terminal states."""
        after = tensordict.get("next")
        terminated = after.get(self.tensor_keys.terminated, None)
        if terminated is None:
            terminated = after.get(self.tensor_keys.done)
        keys = [*self.actor_network.in_keys, *self.qvalue_network.in_keys]
        return without_terminal_entries(after, terminated, keys)

    def _critic_losses(
        self, chosen: Tensor, target: Tensor, tensordict: TensorDictBase
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Returns the summed loss of values ``[N, *B]``, ``td_error`` and each critic's loss."""
        weights = self._maybe_get_priority_weight(tensordict)
        losses = distance_loss(chosen, target.expand_as(chosen), self.loss_function)
        reduced = [
            self._reduce_loss(loss, tensordict=tensordict, weights=weights)
            for loss in losses.unbind(0)
        ]
        metadata = {f"qvalue_loss_{i}": loss.detach() for i, loss in enumerate(reduced)}
        metadata["td_error"] = (chosen.detach() - target).abs().amax(0)
        return torch.stack(reduced).sum(0), metadata

    def _sac_losses(
        self, tensordict: TensorDictBase
    ) -> tuple[Tensor, dict[str, Tensor], Tensor, dict[str, Tensor]]:
        """Returns the critics' loss and diagnostics, and the actor's."""
        return *self.qvalue_loss(tensordict), *self.actor_loss(tensordict)

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        loss_qvalue, critics, loss_actor, policy = self._sac_losses(tensordict)
        skills = self.objective.losses(self.objective.without_empty_states(tensordict))
        weights = self._maybe_get_priority_weight(tensordict)
        log_prob = policy["log_prob"]
        loss_alpha = self._reduce_loss(
            self._alpha_loss(log_prob), tensordict=tensordict, weights=weights
        )
        tensordict.set(self.tensor_keys.priority, critics.pop("td_error"))
        out = {
            "loss_actor": loss_actor,
            "loss_qvalue": loss_qvalue,
            "loss_alpha": loss_alpha,
            **critics,
            **skills,
        }
        if self.reduction == "none":
            batch_size = tensordict.batch_size
        else:
            batch_size = torch.Size([])
            out["alpha"] = self._alpha
            out["entropy"] = -log_prob.mean()
        result = TensorDict({key: out[key] for key in self.out_keys}, batch_size=batch_size)
        self._clear_weakrefs(
            tensordict,
            result,
            "actor_network_params",
            "qvalue_network_params",
            "target_actor_network_params",
            "target_qvalue_network_params",
        )
        return result
