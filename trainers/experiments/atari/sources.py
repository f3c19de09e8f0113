"""Sources of the agent's options: rules, or a network and how it was trained."""

from __future__ import annotations

import inspect
from dataclasses import replace
from functools import partial
from typing import Any

from torchrl_hmcts.trainers.experiments.atari.agent import AtariSearch
from torchrl_hmcts.trainers.experiments.atari.config import RULES, AtariConfig
from torchrl_hmcts.trainers.experiments.atari.fine_tuning import fine_tune, retrain
from torchrl_hmcts.trainers.experiments.atari.kit import AtariKit
from torchrl_hmcts.trainers.experiments.atari.options import Options, OptionSource
from torchrl_hmcts.trainers.experiments.atari.rules import RuleSource
from torchrl_hmcts.trainers.experiments.atari.skills import distil, learn_skills

_TRAININGS: dict[str, Any] = {
    "diayn": learn_skills,
    "distilled": distil,
    "fine_tuned": fine_tune,
    "retrained": retrain,
}


class TrainedSource:
    r"""Options of a network, and how it is trained.

    ``"diayn"`` learns skills by DIAYN on the RAM, before the manager plans: the dissertation's
    worker, 128 - 3 x 128 - actions with ReLU and a softmax, a head for each skill.

    ``"distilled"`` learns another source's options,

    .. math:: \min_\theta\; -\mathbb{E}_{s, z}\, \log \pi_\theta\bigl(\mu_z(s) \mid s, z\bigr)

    with :math:`\mu_z` the option's own worker, in states on the way of random options of that
    worker, and in a second round of the network itself, labelled by the worker (DAgger). The
    network samples its actions, so that it keeps some noise, and takes FIRE in 5 % of its steps,
    where a game has it: one that has forgotten it never starts a game that waits for it.

    ``"fine_tuned"`` trains a distilled network further by soft actor-critic, with the goals' reward
    of :class:`OptionGoals` plus the sign of the game's. The critics learn alone first, and the
    policy is kept near where it began (``policy_prior`` of
    :class:`~torchrl_hmcts.objectives.DiscreteSkillSACLoss`): critics of a policy that hardly varies
    know little of other actions, and would spoil it.

    ``"retrained"`` is Algorithm 3, for skills and for a distilled or fine-tuned network: rounds of
    planning with the worker as it is, every base step of every option that is simulated being kept
    as S; then updates of its own loss on :math:`S \cup D`, with D what it was trained on before,
    and

    .. math:: r = c_i\, r_\phi(s, z, s') + \mathrm{sign}(r_{game}).

    Args:
        training (str): as above.
        source (OptionSource, optional): whose options the training begins with; needed by all but
            ``"diayn"``.
        num_skills (int): Z of ``"diayn"`` (the dissertation's N_policies). Default 3.
        discriminator (str): of ``"diayn"``. ``"state"`` (default) tells skills by the RAM,
            ``"displacement"`` by how it changed since the option began, ``"controllable"`` by how
            its controllable bytes did.
        objective (str): of ``"diayn"``, ``"metra"`` for METRA's on the RAM instead. Default
            ``"diayn"``.
        game_weight (float): of ``"diayn"``, weight of the sign of the game's reward beside the
            objective's. Default 0: none.
        fire (float): of ``"diayn"``, share of the steps in which FIRE is taken, where a game has
            it. Default 0.
        base_steps (int): of training. Default 40,000 for ``"diayn"``, 20,000 for ``"fine_tuned"``.
        skill_steps, num_envs (int): in both, base steps for which an option is kept, and emulators
            that play at a time. Default 40 and 8.
        hidden (sequence of int): widths of the shared layers of a new network. Default: three of
            128.
        samples, epochs, batch_size (int): of ``"distilled"``: labelled states of each round, passes
            over all of them, and labels of an update. Default 20,000, 8 and 256.
        lr (float): Adam's learning rate (of the actor). Default 1e-3 for ``"distilled"``, 1e-4 for
            ``"fine_tuned"``, 3e-4 for ``"retrained"``.
        warm_up (float): share of the training (default 0.25), or of the first round's updates
            (default 0.75), in which new critics learn alone.
        updates_per_batch (int): of ``"fine_tuned"``, for 64 base steps. Default 16.
        search (AtariSearch): of ``"retrained"``, the planner. Default: with a ratio of 10.
        rounds, round_steps, option_steps (int): of ``"retrained"``, real base steps of a round and
            base steps of an option among them. Default 3, 300 and 10.
        intrinsic_weight (float): :math:`c_i`. Default 1.

    Raises:
        TypeError: if a keyword is unknown, or a source is missing or not needed; when searching, if
            the source's options cannot be trained like this.
        ValueError: if the training is unknown; when searching, if a number is out of range, or no
            byte of the game can be controlled.

    Reference:
        Dissertation, chapter 5 and algorithm 3; Eysenbach et al., "Diversity is All You Need",
        2018, arXiv 1802.06070; Ross, Gordon and Bagnell, "A reduction of imitation learning and
        structured prediction to no-regret online learning", 2011, arXiv 1011.0686; Christodoulou,
        "Soft Actor-Critic for Discrete Action Settings", 2019, arXiv 1910.07207.

    Example:
        >>> from torchrl_hmcts.trainers import RuleSource, TrainedSource
        >>> network = TrainedSource("distilled", RuleSource("repeat"), samples=5_000)
        >>> TrainedSource("fine_tuned", network, base_steps=2_000).settings
        {'base_steps': 2000}
    """

    def __init__(self, training: str, source: OptionSource | None = None, **settings: Any) -> None:
        if training not in _TRAININGS:
            raise ValueError(
                f"TrainedSource: training is one of {', '.join(_TRAININGS)}; got {training!r}."
            )
        if (source is None) != (training == "diayn"):
            needs = "begins with no other" if training == "diayn" else "needs another source"
            raise TypeError(f"TrainedSource({training!r}) {needs}; got {source!r}.")
        self.training, self.source, self.settings = training, source, settings
        begin = [] if source is None else [None]
        inspect.signature(_TRAININGS[training]).bind(*begin, None, **settings)

    def find(self, kit: AtariKit) -> Options:
        """Return the options of a game."""
        begin = [] if self.source is None else [self.source.find(kit)]
        options: Options = _TRAININGS[self.training](*begin, kit, **self.settings)
        return options


def make_source(config: AtariConfig, search: AtariSearch) -> OptionSource:
    """Return the source that a configuration names, with the planner of its trials."""
    rules = partial(
        RuleSource,
        search=search,
        min_options=2,
        trial_steps=config.trial_steps,
        trial_ratio=config.trial_ratio,
    )
    if config.source in RULES:
        return rules(candidates=config.source)
    steps: dict[str, Any] = {"base_steps": config.skill_base_steps}
    name, retrained = config.source.removesuffix("_retrained"), "_retrained" in config.source
    weight = 1.0
    if name.startswith("goals"):
        source = TrainedSource("distilled", rules(candidates="goals"))
        if name == "goals_fine_tuned":
            source = TrainedSource("fine_tuned", source, **steps)
    else:
        objective, _, seen = name.partition("_")
        skills: dict[str, Any] = {"objective": objective, "discriminator": seen or "state"}
        skills["fire"] = config.fire
        skills |= {"game_weight": config.game_weight, "num_skills": config.num_skills}
        source = TrainedSource("diayn", **skills, **steps)
        weight = 0.1
    if not retrained:
        return source
    return TrainedSource(
        "retrained",
        source,
        intrinsic_weight=weight,
        rounds=config.rounds,
        round_steps=config.trial_steps,
        search=replace(search, ratio=config.trial_ratio),
        option_steps=config.option_steps or 10,
    )
