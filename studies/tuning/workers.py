"""Designs of a tuning on the workers of a cluster: each evaluates a part."""

from __future__ import annotations

import json
import time
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from studies import config
from studies.cluster.watch import Watch
from studies.cluster.worker import identity, working
from studies.errors import StudyError
from studies.tuning.evaluate import Evaluation, Evaluator
from studies.tuning.optimise import start_families
from studies.tuning.spec import TuneSpec, parse_tuning

if TYPE_CHECKING:
    from collections.abc import Callable

    from distributed import Client, Future


class Share(NamedTuple):
    """Designs for one worker."""

    identity: dict[str, str]  # of the client
    precision: str
    spec: str  # the tuning as JSON
    families: tuple[int, ...]  # of the designs, positions in `spec.moving`
    values: np.ndarray  # of the free parameters, (designs, p)
    needs_gradient: np.ndarray  # (designs,)


class ShareDone(NamedTuple):
    """A worker's result of its part."""

    evaluation: Evaluation
    worker: str  # address


def evaluate_part(part: Share) -> ShareDone:
    """Evaluate designs on a worker.

    Raises:
        StudyError: the worker has other versions than the client; a fault of the tuning.
    """
    with working(part.identity, part.precision) as worker:
        evaluator = _evaluator(part.precision, part.spec, part.families)
        return ShareDone(evaluator.evaluate(part.values, part.needs_gradient), worker.address)


@lru_cache(maxsize=2)
def _evaluator(precision: str, text: str, families: tuple[int, ...]) -> Evaluator:
    spec = parse_tuning(json.loads(text))
    return Evaluator(spec, [spec.moving[k] for k in families])


class ClusterEvaluator(Evaluator):
    """The same designs in the same order, evaluated in parts by the currently available workers."""

    def __init__(
        self, spec: TuneSpec, notify: Callable[[str], None], client: Client, timeout: float
    ) -> None:
        """
        Args:
            spec: the tuning.
            notify: called with what users should know.
            client: from `connected`.
            timeout: a worker that stays busy for longer without answering is restarted [s].
        """
        families = start_families(spec)
        super().__init__(spec, [spec.moving[k] for k in families])
        self._client, self._watch = client, Watch(client, timeout, notify)
        self._text, self._identity = json.dumps(spec.data), identity()
        self._precision = config.origin()["precision"]
        count = min(max(self._watch.n_workers, 1), len(families))
        self._parts = np.array_split(np.arange(len(families)), count)
        self._families = [tuple(map(int, families[part])) for part in self._parts]
        self._is_compiled = False
        most = len(self._parts[0])
        notify(f"workers: {self._watch.n_workers}, each with {most} starting points or fewer")

    def evaluate(self, values: np.ndarray, needs_gradient: np.ndarray | bool = True) -> Evaluation:
        needed, started = np.broadcast_to(needs_gradient, len(values)), time.perf_counter()
        futures = [
            self._client.submit(
                evaluate_part,
                Share(
                    identity=self._identity,
                    precision=self._precision,
                    spec=self._text,
                    families=families,
                    values=values[part],
                    needs_gradient=needed[part],
                ),
                pure=False,
            )
            for part, families in zip(self._parts, self._families, strict=True)
        ]
        evaluations = self._gather(futures)
        if self._is_compiled:
            self.run_time = (time.perf_counter() - started) / self.lanes
        self._is_compiled = True
        return Evaluation(*(np.concatenate(x) for x in zip(*evaluations, strict=True)))

    def _gather(self, futures: list[Future[Any]]) -> list[Evaluation]:
        """Answers in the order of the parts."""
        answers: dict[Future[Any], Any] = {}
        try:
            while len(answers) < len(futures):
                left = [future for future in futures if future not in answers]
                for future in self._watch.finished(left):
                    answers[future] = self._watch.outcome(future)
                    if isinstance(answers[future], str):
                        raise StudyError(
                            f"a part of the designs cannot be evaluated: {answers[future]}; "
                            "earlier iterations are safe; continue with --resume"
                        )
        finally:
            self._client.cancel(futures)
        return [answers[future].evaluation for future in futures]
