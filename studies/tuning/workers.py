"""Designs of a tuning on the workers of a cluster: each evaluates a part."""

from __future__ import annotations

import json
import time
from functools import lru_cache

import numpy as np

from studies import config
from studies.cluster.remote import Remote
from studies.errors import StudyError
from studies.tuning.evaluate import Evaluation, Evaluator
from studies.tuning.optimise import start_families
from studies.tuning.spec import TuneSpec, parse_tuning


def evaluate_part(
    spec: str, families: tuple[int, ...], values: np.ndarray, needs_gradient: np.ndarray
) -> Evaluation:
    """Evaluate designs on a worker.

    Args:
        spec: the tuning as JSON.
        families: of the designs, positions in `spec.moving`.
        values: of the free parameters, (designs, p).
        needs_gradient: as in `Evaluator.evaluate`, (designs,).

    Raises:
        StudyError: a fault of the tuning.
    """
    evaluator = _evaluator(config.origin()["precision"], spec, families)
    return evaluator.evaluate(values, needs_gradient)


@lru_cache(maxsize=2)
def _evaluator(precision: str, text: str, families: tuple[int, ...]) -> Evaluator:
    spec = parse_tuning(json.loads(text))
    return Evaluator(spec, [spec.moving[k] for k in families])


class ClusterEvaluator(Evaluator):
    """The same designs in the same order, evaluated in parts by the currently available workers."""

    def __init__(self, spec: TuneSpec, remote: Remote) -> None:
        families = start_families(spec)
        super().__init__(spec, [spec.moving[k] for k in families])
        self._text, self._remote = json.dumps(spec.data), remote
        n_workers = remote.n_workers
        count = min(max(n_workers, 1), len(families))
        self._parts = np.array_split(np.arange(len(families)), count)
        self._families = [tuple(map(int, families[part])) for part in self._parts]
        self._is_compiled = False
        most = len(self._parts[0])
        remote.say(f"workers: {n_workers}, each with {most} starting points or fewer")

    def evaluate(self, values: np.ndarray, needs_gradient: np.ndarray | bool = True) -> Evaluation:
        needed, started = np.broadcast_to(needs_gradient, len(values)), time.perf_counter()
        jobs = [
            (k, (self._text, self._families[k], values[part], needed[part]))
            for k, part in enumerate(self._parts)
        ]
        answers = dict(self._remote.map(evaluate_part, jobs))
        for answer in answers.values():
            if isinstance(answer, str):
                raise StudyError(
                    f"a part of the designs cannot be evaluated: {answer}; earlier iterations are "
                    "safe; continue with --resume"
                )
        if self._is_compiled:
            self.run_time = (time.perf_counter() - started) / self.lanes
        self._is_compiled = True
        ordered = zip(*(answers[k] for k in range(len(jobs))), strict=True)
        return Evaluation(*map(np.concatenate, ordered))
