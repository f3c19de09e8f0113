"""Which features of the state an agent controls, found by trying its actions.

Letters: S states, A actions, F features.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torchrl.envs import EnvBase

from torchrl_hmcts.planners.simulator import Simulator


@dataclass(frozen=True)
class Controllability:
    r"""Effects of the actions on each feature.

    Attributes:
        effects: float64 ``[A, F]``, mean change of a feature by an action minus its mean change
            by the neutral one; bytes wrap around.
        dependence: float64 ``[F]``, share of the states in which a feature's next value depends on
            the action.
        num_values: int64 ``[F]``, values that a feature takes.
        motion: float64 ``[F]``, share of the states in which the neutral action changes a feature.
        min_dependence, min_values, min_motion: of a controllable or moving feature, at least.
        min_effect: mean change that counts as raising or lowering.

    Example:
        >>> import numpy as np
        >>> found = Controllability(
        ...     effects=np.array([[0.0, 0.0], [2.0, 0.0], [-2.0, 0.0]]),
        ...     dependence=np.array([0.9, 0.0]), num_values=np.array([40, 60]),
        ...     motion=np.array([0.0, 0.8]))
        >>> found.controllable.tolist(), found.moving.tolist()
        ([0], [1])
        >>> found.raising(0).tolist(), found.lowering(0).tolist()
        ([1], [2])
    """

    effects: np.ndarray
    dependence: np.ndarray
    num_values: np.ndarray
    motion: np.ndarray
    min_dependence: float = 0.15
    min_values: int = 16
    min_effect: float = 0.5
    min_motion: float = 0.15

    @property
    def controllable(self) -> np.ndarray:
        """Features that depend on the action and that some action raises and another lowers."""
        both = (self.effects.max(0) > self.min_effect) & (self.effects.min(0) < -self.min_effect)
        enough = (self.dependence > self.min_dependence) & (self.num_values >= self.min_values)
        found: np.ndarray = np.flatnonzero(both & enough)
        return found

    @property
    def moving(self) -> np.ndarray:
        """Features of many values that change by themselves and are not controllable."""
        moves = (self.motion > self.min_motion) & (self.num_values >= self.min_values)
        moves[self.controllable] = False
        found: np.ndarray = np.flatnonzero(moves)
        return found

    def raising(self, feature: int) -> np.ndarray:
        """Actions that raise a feature, the strongest first."""
        return self._strongest(self.effects[:, feature])

    def lowering(self, feature: int) -> np.ndarray:
        """Actions that lower a feature, the strongest first."""
        return self._strongest(-self.effects[:, feature])

    def _strongest(self, effect: np.ndarray) -> np.ndarray:
        order = np.argsort(-effect, kind="stable")
        found: np.ndarray = order[effect[order] > self.min_effect]
        return found


def random_states(pool: Any, count: int, seed: int) -> TensorDictBase:
    """Return states on the way of random options, of as many episodes as it takes."""
    generator = torch.Generator().manual_seed(seed)
    states: list[TensorDictBase] = []
    td = pool.reset(TensorDict(batch_size=[1]))
    keys = [key for key in td.keys(True, True) if key not in pool.done_keys]
    while len(states) < count:
        option = torch.randint(pool.num_options, (1,), generator=generator)
        td = pool.step(td.select(*keys).set("option", option))["next"]
        if td["done"].any():
            td = pool.reset(TensorDict(batch_size=[1]))
        else:
            states.append(td.select(*keys))
    return torch.cat(states)  # type: ignore[call-overload,no-any-return]


def probe_controllability(
    env: EnvBase,
    states: TensorDictBase,
    key: NestedKey,
    *,
    neutral: int = 0,
    **thresholds: float,
) -> Controllability:
    r"""Take every action in every state and compare which features it changes.

    .. math:: e_{a f} = \frac{1}{S} \sum_s \Delta_f(s, a) - \Delta_f(s, a_0)

    Dependence alone is not control: what an action sets off, e.g. a ball, depends on it too. A
    feature is controllable if one action raises it and another lowers it.

    Args:
        env (EnvBase): any macro environment whose actions are held for some base steps.
        states (TensorDictBase): ``[S]``, what to try the actions from.
        key (NestedKey): features, integer or float ``[S, F]``; differences of uint8 wrap around.
        neutral (int): the action that changes least.
        **thresholds: of :class:`Controllability`.

    Raises:
        ValueError: if the env cannot be set to a state, there is no state, or ``neutral`` is no
            action.

    Reference:
        This project's; controllable features as in Bengio et al., "Independently controllable
        features", 2017, arXiv 1703.07718.

    Example:
        >>> from torchrl_hmcts.testing import PointMassEnv
        >>> from torchrl_hmcts.trainers import probe_controllability
        >>> env = PointMassEnv(batch_size=[50])
        >>> found = probe_controllability(  # the actions are up (neutral), down, left, right
        ...     env, env.reset(), "velocity", min_values=3, min_effect=0.05)
        >>> found.controllable.tolist(), found.raising(0).tolist(), found.lowering(0).tolist()
        ([0], [3], [2])
    """
    simulator = Simulator(env, extra_keys=[key])
    num_options = simulator.num_options
    if not 0 <= neutral < num_options:
        raise ValueError(
            f"probe_controllability needs a neutral action from 0 to {num_options - 1}; got "
            f"{neutral}."
        )
    count = states.batch_size.numel()
    if not count:
        raise ValueError("probe_controllability tries the actions in states; got none.")
    rows = torch.arange(count).repeat_interleave(num_options)
    options = np.tile(np.arange(num_options), count)
    roots = simulator.root(states.reshape(-1))
    before = states.reshape(-1).get(key).reshape(count, 1, -1).cpu().numpy()
    with torch.no_grad():
        stepped = simulator.step(roots[rows], options)
    after = stepped.get(key).reshape(count, num_options, -1).cpu().numpy()
    if before.dtype == np.uint8:
        change = (after - before).astype(np.int8).astype(np.float64)
    else:
        change = after.astype(np.float64) - before.astype(np.float64)
    flat = after.reshape(-1, after.shape[-1])
    return Controllability(
        effects=(change - change[:, neutral : neutral + 1]).mean(0),
        dependence=(after != after[:, :1]).any(1).mean(0),
        num_values=np.array([len(np.unique(flat[:, f])) for f in range(flat.shape[1])]),
        motion=(change[:, neutral] != 0).mean(0),
        **thresholds,  # type: ignore[arg-type]
    )
