"""Where the agent's options come from: rules, or a network and how it was trained."""

from __future__ import annotations

import inspect
from functools import partial
from typing import Any

from torchrl_hmcts.trainers.experiments.atari.agent import AtariSearch
from torchrl_hmcts.trainers.experiments.atari.config import AtariConfig
from torchrl_hmcts.trainers.experiments.atari.fine_tuning import fine_tune, retrain
from torchrl_hmcts.trainers.experiments.atari.kit import AtariKit
from torchrl_hmcts.trainers.experiments.atari.options import Options, OptionSource
from torchrl_hmcts.trainers.experiments.atari.rules import CANDIDATES, RuleSource
from torchrl_hmcts.trainers.experiments.atari.skills import distil, learn_skills

_TRAININGS: dict[str, Any] = {
    "diayn": learn_skills,
    "distilled": distil,
    "fine_tuned": fine_tune,
    "retrained": retrain,
}


class TrainedSource:
    """Options of a network, and how it is trained.

    ================ ===============================================================================
    ``training``     what the network learns
    ================ ===============================================================================
    ``"diayn"``      skills, by DIAYN on the RAM:
                     :func:`~torchrl_hmcts.trainers.experiments.atari.skills.learn_skills`
    ``"distilled"``  another source's options:
                     :func:`~torchrl_hmcts.trainers.experiments.atari.skills.distil`
    ``"fine_tuned"`` a distilled source's goals and the game, by soft actor-critic:
                     :func:`~torchrl_hmcts.trainers.experiments.atari.fine_tuning.fine_tune`
    ``"retrained"``  the same, or skills, on all that searches simulated (Algorithm 3):
                     :func:`~torchrl_hmcts.trainers.experiments.atari.fine_tuning.retrain`
    ================ ===============================================================================

    Args:
        training (str): as above.
        source (OptionSource, optional): whose options the training begins with; needed by all but
            ``"diayn"``.
        **settings: keywords of the function above.

    Raises:
        TypeError: if a keyword is unknown, or a source is missing or not needed; when searching, if
            the source's options cannot be trained like this.
        ValueError: if the training is unknown; when searching, if a number is out of range.

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
    if config.source in CANDIDATES:
        return rules(candidates=config.source)
    steps: dict[str, Any] = {"base_steps": config.skill_base_steps}
    rounds: dict[str, Any] = {"round_steps": config.trial_steps}
    network = TrainedSource("distilled", rules(candidates="goals"))
    skills = partial(TrainedSource, "diayn", num_skills=config.num_skills, **steps)
    networks = {
        "goals_network": network,
        "goals_fine_tuned": TrainedSource("fine_tuned", network, **steps),
        "goals_retrained": TrainedSource("retrained", network, **rounds),
        "diayn": skills(),
        "diayn_displacement": skills(discriminator="displacement"),
        "diayn_controllable": skills(discriminator="controllable"),
        "diayn_retrained": TrainedSource("retrained", skills(), intrinsic_weight=0.1, **rounds),
    }
    return networks[config.source]
