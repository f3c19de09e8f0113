"""Checks for parts of your own, and tiny environments with known solutions to try them in.

A check is a function over the part. It returns nothing if the part keeps its contract, and else
raises a :class:`ContractError` that says what is wrong, why it matters and what to do.
"""

from torchrl_hmcts.testing.contract import ContractError
from torchrl_hmcts.testing.env_checks import check_env, check_macro_env, check_parallel_env
from torchrl_hmcts.testing.loss_checks import LOSS_CHECKS, check_loss
from torchrl_hmcts.testing.search_checks import (
    check_evaluator,
    check_novelty,
    check_option_prior,
    check_planner,
    check_tree_policy,
)
from torchrl_hmcts.testing.settable_checks import check_settable
from torchrl_hmcts.testing.solvable_envs import ChainEnv, PointMassEnv, TableEnv
from torchrl_hmcts.testing.transform_checks import TRANSFORM_CHECKS, check_transform
from torchrl_hmcts.testing.worker_checks import (
    check_skill_objective,
    check_skill_prior,
    check_termination,
    check_worker,
)

__all__ = [
    "LOSS_CHECKS",
    "TRANSFORM_CHECKS",
    "ChainEnv",
    "ContractError",
    "PointMassEnv",
    "TableEnv",
    "check_env",
    "check_evaluator",
    "check_loss",
    "check_macro_env",
    "check_novelty",
    "check_option_prior",
    "check_parallel_env",
    "check_planner",
    "check_settable",
    "check_skill_objective",
    "check_skill_prior",
    "check_termination",
    "check_transform",
    "check_tree_policy",
    "check_worker",
]
