"""A collector whose processes may die: they are started again."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator
from typing import Any

from tensordict import TensorDictBase


class CollectorError(RuntimeError):
    """Processes that collect died again and again.

    Examples:
        >>> from torchrl_hmcts.trainers import CollectorError
        >>> issubclass(CollectorError, RuntimeError)
        True
    """


class RestartingCollector:
    """Builds its collector anew when a process of it dies, and goes on collecting.

    The batch that was under way is lost, and the episodes: new ones begin. All other attributes are
    those of the collector it has built last.

    Args:
        make (callable): called with the base steps that are left and the number of deaths so far,
            it builds a collector, with the weights in place.
        died (callable): called with the collector and what it raised, it says whether a process of
            it died. Anything else is raised as it is.
        total_frames (int): base steps in all.
        max_deaths (int): deaths with no batch between them that are borne. Default 3.

    Attributes:
        num_restarts (int): collectors built after the first.

    Raises:
        CollectorError: when collecting, saving or sending weights, after more deaths than that.
    """

    def __init__(
        self,
        make: Callable[[int, int], Any],
        died: Callable[[Any, Exception], bool],
        total_frames: int,
        *,
        max_deaths: int = 3,
    ) -> None:
        self._make, self._died = make, died
        self.total_frames, self.max_deaths = total_frames, max_deaths
        self.collected_frames = 0
        self.num_restarts = 0
        self._deaths = 0
        self._collector = make(total_frames, 0)

    def __getattr__(self, name: str) -> Any:
        if name == "_collector":  # not built yet
            raise AttributeError(name)
        return getattr(self._collector, name)

    def __iter__(self) -> Iterator[TensorDictBase]:
        while self.collected_frames < self.total_frames:
            collector = self._collector
            try:
                for batch in collector:
                    self._deaths = 0
                    self.collected_frames += batch.numel()
                    yield batch
                    if self._collector is not collector:  # it died outside of this loop
                        break
                else:
                    return
            except Exception as error:
                self._restart(error)

    def update_policy_weights_(self, *args: Any, **kwargs: Any) -> None:
        """Send the weights to the processes."""
        self._ask(lambda collector: collector.update_policy_weights_(*args, **kwargs))

    def state_dict(self, *args: Any, **kwargs: Any) -> Any:
        """Return the collector's state, of the processes too."""
        return self._ask(lambda collector: collector.state_dict(*args, **kwargs))

    def load_state_dict(self, *args: Any, **kwargs: Any) -> None:
        """Put back a state of :meth:`state_dict`."""
        self._ask(lambda collector: collector.load_state_dict(*args, **kwargs))

    def shutdown(self, *args: Any, **kwargs: Any) -> None:
        """End the processes."""
        self._collector.shutdown(*args, **kwargs)

    def _ask(self, question: Callable[[Any], Any]) -> Any:
        while True:
            try:
                return question(self._collector)
            except Exception as error:
                self._restart(error)

    def _restart(self, error: Exception) -> None:
        while True:
            if not self._died(self._collector, error):
                raise error
            self._deaths += 1
            with contextlib.suppress(Exception):  # what is left of it
                self._collector.shutdown()
            what = f"A process that collects died ({_first_line(error)})"
            if self._deaths > self.max_deaths:
                raise CollectorError(
                    f"{what}, {self._deaths} times without a batch between them, after "
                    f"{self.collected_frames} base steps. Look for what ends it: too little "
                    "memory, or an env that crashes; collector=local runs it in this process."
                ) from error
            print(f"{what}; it is started again.", file=sys.stderr)
            self.num_restarts += 1
            left = self.total_frames - self.collected_frames
            try:
                self._collector = self._make(left, self.num_restarts)
                return
            except Exception as again:
                error = again


def _first_line(error: Exception) -> str:
    return f"{type(error).__name__}: {(str(error).splitlines() or [''])[0]}".rstrip(": ")
