"""Goals on features of any Gymnasium env, found by trying its actions: chapter 3's, automatic."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import gymnasium
import numpy as np
from tensordict import TensorDictBase

from torchrl_hmcts.envs import FeatureGoal, FollowGoals, OptionPool, RepeatActions
from torchrl_hmcts.envs.gym.features import Features, whole_observation
from torchrl_hmcts.envs.gym.task import fixed_actions
from torchrl_hmcts.trainers.runs.config import ExperimentError
from torchrl_hmcts.trainers.skills.controllability import probe_controllability, random_states

_STATES = 60  # in which every action is tried
_EFFECT = 0.02  # of a feature's span, that an action must raise and another must lower
_VALUES = np.linspace(-0.1, 1.1, 5)  # goals on one feature, of its span: the ends lie beyond it
_DEAD_ZONE = 0.05  # of a feature's span, within which a goal is reached


def find_goals(
    make: Callable[..., gymnasium.Env],
    features: Features,
    starts: TensorDictBase,
    *,
    option_steps: int,
    seed: int = 0,
) -> FollowGoals:
    r"""Return goals "bring a feature to a value" for each feature that actions control.

    Every action is held in states of random walks. Its effect is the mean change of a feature, less
    that of all actions, as a share of the feature's span,

    .. math:: e_{af} = \frac{\bar\Delta_{af} - \frac{1}{A} \sum_b \bar\Delta_{bf}}{\text{span}_f}.

    A feature that one action raises and another lowers gets five values, evenly from a tenth of its
    span below what the walks, the starts ``[S]`` and their goals have to a tenth above. Where a
    worker's observation does not show the features, it is the whole observation instead.
    """
    env = make()
    try:
        features(None, env.reset(seed=0)[0])  # type: ignore[arg-type]
    except AttributeError:  # it reads the simulator, which no worker has
        features = whole_observation
    actions = fixed_actions(env.action_space)
    pool = OptionPool(
        make,
        RepeatActions(actions),
        max_steps=option_steps,
        num_processes=0,
        features=features,
        seed=seed,
    )
    states = random_states(pool, _STATES, seed)
    found = probe_controllability(
        pool, states, "features", min_dependence=0.1, min_values=3, min_effect=_EFFECT
    )
    points = states["features"].double().numpy()
    for key in ("features", "desired_goal"):
        if key in starts.keys() and starts[key].shape[-1] == points.shape[-1]:
            points = np.concatenate([points, starts[key].double().numpy()])
    low, span = points.min(0), np.ptp(points, 0)
    effects = (found.effects - found.effects.mean(0)) / np.maximum(span, 1e-9)
    found = replace(found, effects=effects)
    goals = [
        FeatureGoal(
            features,
            c,
            float(low[c] + span[c] * share),
            actions[found.raising(c)[0]],
            actions[found.lowering(c)[0]],
            float(_DEAD_ZONE * span[c]),
        )
        for c in found.controllable.tolist()
        for share in _VALUES
    ]
    if not goals:
        raise ExperimentError(
            "options=goals needs a feature that one action raises and another lowers; trying "
            f"{len(actions)} actions in {_STATES} states of {env} found none. Use options=actions."
        )
    return FollowGoals(goals)
