"""The base transitions of every option an env takes, kept for training.

Letters: *B batch of the tensordict, T base steps an option can take at most, n recorded steps.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.data import Composite

from torchrl_hmcts.checks import instance, nested_key
from torchrl_hmcts.transforms.env_transform import EnvTransform
from torchrl_hmcts.transforms.trajectory import OptionTrajectory


class OptionRecorder(EnvTransform):
    r"""Keeps the base transitions that options consist of, wherever the options are taken.

    Append it after an :class:`OptionTransform` that returns its base transitions. It removes them
    from the tensordict and stores those that were taken, each with the option as its skill and the
    displacement since the option began, as :class:`DisplacementTransform` writes it,

    .. math:: \Delta_t = x_t - x_{t_0}, \qquad t_0 = \text{the option's first base step}

    Transitions that a planner simulates are recorded like those that are executed, so the search
    yields data to train its worker. They are kept until :meth:`take` is called.

    Args:
        keys (sequence of NestedKey): entries of a base transition to store, e.g. the ``in_keys`` of
            the loss: ``"velocity"``, ``"action"``, ``("next", "velocity")``. ``skill_key`` and
            ``displacement_key``, under ``"next"`` too, are written by the recorder.
        position_key (NestedKey): entry ``[*B, D]`` whose displacement is measured; read only if
            ``displacement_key`` is among the ``keys``.
        displacement_key (NestedKey): displacement to write, ``[n, D]``.
        skill_key (NestedKey): entry under which the ``OptionTransform`` tells the worker its option
            and under which it is stored, int64 ``[n]``.

    Raises:
        ValueError: at construction if ``keys`` names nothing to record.
        KeyError: when attached, if the env before it does not hand out what is to be recorded.

    Reference:
        Bartley 2023, algorithm 3: the samples S on which the skills are trained again.

    Examples:
        >>> import torch
        >>> from tensordict.nn import TensorDictModule
        >>> from torchrl.envs import Compose, TransformedEnv
        >>> from torchrl_hmcts.testing import ChainEnv
        >>> from torchrl_hmcts.transforms import OptionRecorder, OptionTransform
        >>> worker = TensorDictModule(lambda skill: skill, ["skill"], ["action"])
        >>> recorder = OptionRecorder(["skill", ("next", "state")])
        >>> options = OptionTransform(worker, 2, 3, trajectory_keys=recorder.trajectory_keys)
        >>> env = TransformedEnv(ChainEnv(length=9), Compose(options, recorder))
        >>> td = env.step(env.reset().set("option", torch.tensor(1)))  # 1: three to the right
        >>> data = recorder.take()
        >>> data["next", "state"].tolist(), data["skill"].tolist()
        ([1, 2, 3], [1, 1, 1])
    """

    def __init__(
        self,
        keys: Sequence[NestedKey],
        *,
        position_key: NestedKey = "position",
        displacement_key: NestedKey = "displacement",
        skill_key: NestedKey = "skill",
    ) -> None:
        super().__init__(in_keys=[OptionTrajectory.KEY], out_keys=[])
        instance("OptionRecorder", "keys", keys, list, tuple)
        self.keys = [nested_key("OptionRecorder", "keys", key) for key in keys]
        self.position_key = nested_key("OptionRecorder", "position_key", position_key)
        self.displacement_key = nested_key("OptionRecorder", "displacement_key", displacement_key)
        self.skill_key = nested_key("OptionRecorder", "skill_key", skill_key)
        self.num_base_steps = 0
        """Base steps recorded so far, an int."""
        self._next_position = _next(self.position_key)
        moves = (self.displacement_key, _next(self.displacement_key))
        made = {self.skill_key, _next(self.skill_key), *moves}
        needed = [key for key in self.keys if key not in made]
        if any(key in moves for key in self.keys):
            needed += [self.position_key, self._next_position]
        self.trajectory_keys: list[NestedKey] = list(dict.fromkeys(needed))
        """What the ``OptionTransform`` must hand out: its argument of the same name."""
        if not self.trajectory_keys:
            raise ValueError(
                f"OptionRecorder was given the keys {self.keys}, of which none is an entry of a "
                'base transition. Name what to store, e.g. ["action", ("next", "velocity")].'
            )
        self._blocks: list[tuple[TensorDictBase, Tensor]] = []

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        block = next_tensordict.pop(OptionTrajectory.KEY)  # [*B, T]
        skill = tensordict.get(self.skill_key, None)
        if skill is None:
            raise KeyError(
                f"OptionRecorder found no skill under {self.skill_key!r}. Give it the skill_key of "
                "the OptionTransform, and put both on the same side of a SerialEnv or ParallelEnv."
            )
        skill = skill.clone()  # a planner may use the memory of its options again
        self._blocks.append((block.reshape(-1, block.shape[-1]), skill.reshape(-1)))
        self.num_base_steps += int(block.get(OptionTrajectory.MASK_KEY).sum())
        return next_tensordict

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        tensordict_reset.pop(OptionTrajectory.KEY, None)
        return tensordict_reset

    def take(self) -> TensorDictBase:
        """Hands over the transitions ``[n]`` recorded since the last call and forgets them.

        Their entries are ``keys``, those of an option one after the other; there are none without
        any.
        """
        if not self._blocks:
            return TensorDict(batch_size=[0])
        blocks, skills = zip(*self._blocks, strict=True)
        self._blocks = []
        block: TensorDictBase = torch.cat(blocks) if len(blocks) > 1 else blocks[0]  # [m, T]
        skill = torch.cat(skills)
        mask = block.get(OptionTrajectory.MASK_KEY)
        out = TensorDict(batch_size=[int(mask.sum())], device=block.device)
        for key in self.keys:
            if key in (self.skill_key, _next(self.skill_key)):
                entry = skill.unsqueeze(-1).expand(mask.shape)
            elif key in (self.displacement_key, _next(self.displacement_key)):
                where = self.position_key if key == self.displacement_key else self._next_position
                entry = block.get(where) - block.get(self.position_key)[:, :1]
            else:
                entry = block.get(key)
            out.set(key, entry[mask])
        return out

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        key = OptionTrajectory.KEY
        handed = observation_spec[key].keys(True, True) if key in observation_spec.keys() else ()
        self._require(
            handed,
            *self.trajectory_keys,
            advice="Put it after an OptionTransform with trajectory_keys=recorder.trajectory_keys.",
        )
        observation_spec = observation_spec.clone()
        del observation_spec[key]
        return observation_spec

    def _stays_outside(self) -> str | None:
        return "hands over here what it records"


def _next(key: NestedKey) -> NestedKey:
    return unravel_key(("next", key))
