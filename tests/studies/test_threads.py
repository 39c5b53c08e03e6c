"""Runs and settings shared by the threads of a process."""

import asyncio
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest
import scipy.linalg  # noqa: F401  # has a BLAS of its own
from threadpoolctl import threadpool_info

from studies.engine.runs import run_study
from studies.threads import SharedSetting, serial_blas
from tests.canonical import TINY, study_of


def blas_threads():
    return {found["num_threads"] for found in threadpool_info() if found["user_api"] == "blas"}


def test_any_thread_may_limit_blas():
    """Also while one that has limited it before lives: OpenBLAS listened to that one alone."""
    made = []
    setting = SharedSetting(lambda: made.append(1) or (lambda: made.append(0)))
    with setting(), setting():
        assert made == [1]
    assert made == [1, 0]
    with serial_blas():
        assert blas_threads() == {1}

    def limited():
        with serial_blas():
            return blas_threads()

    with ThreadPoolExecutor(2) as pool:
        assert [pool.submit(limited).result() for _ in range(2)] == [{1}, {1}]


def assert_equal_from_threads(rounds):
    """Runs from two and four threads, from a pool and `asyncio`, equal those of one thread."""
    study = study_of(TINY)
    gains = [0.5, 1.0, 1.5, 2.0]

    def margin(gain):
        run = run_study(study.change(control__gain_factor=gain), has_record=False)
        return run.loop.gain_margin, float(run.result.metrics.residual_rms[0, 0])

    def note(found, k):
        found[k] = margin(gains[k])

    async def gathered():
        return await asyncio.gather(*(asyncio.to_thread(margin, gain) for gain in gains))

    wanted = list(map(margin, gains))
    for n in range(rounds):
        count = 2 if n % 2 else 4
        found = {}
        threads = [
            threading.Thread(target=note, args=(found, k), daemon=True) for k in range(count)
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(120)
        assert [found.get(k) for k in range(count)] == wanted[:count]
    assert asyncio.run(gathered()) == wanted


def test_runs_of_several_threads_end_and_are_equal():
    assert_equal_from_threads(4)


@pytest.mark.long
def test_two_hundred_rounds_of_threads_end():
    assert_equal_from_threads(200)
