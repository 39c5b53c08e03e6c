"""`studies bench`: every key is there; other solvers do the same work (`campaigns.peers`)."""

import json
import shutil
from unittest.mock import patch

import jax
import numpy as np
import pytest

from campaigns import peers
from studies import cli
from studies.bench.works import WORKS
from studies.engine.executor import Executor
from tests.bare import paper_study

KEYS = "work executor configs_per_s compile_s peak_mib device dtype batch steps fingerprint"


@pytest.fixture(scope="module")
def work():
    with patch.dict(WORKS["W0"], link__modes=3):
        return peers.make_work(is_short=True)


@pytest.fixture(scope="module")
def own(work):
    """Residual vibration by the kernel."""
    run = Executor(work.structure, work.layout, kind="kernel").start(work.cases)
    return run.wait().metrics.residual_rms


def check_agreement(rms, own):
    wanted = own[: len(rms)]
    assert wanted.min() > 1e-9
    np.testing.assert_allclose(rms, wanted, atol=2e-6 * wanted.max())


def test_hand_written_c_agrees(work, own):
    compiler = shutil.which("gcc") or shutil.which("clang")
    if not compiler:
        pytest.skip("neither gcc nor clang is installed")
    check_agreement(peers.by_c(work, compiler, 4)(), own)


def test_adaptive_steps_agree(work, own):
    check_agreement(peers.by_scipy(work)(), own)


@pytest.mark.long
def test_all_peers_agree():
    """By closed form, Lagrangian and C; ETDRK4, RK4, Tsit5 and adaptive steps."""
    lines = []
    rows = peers.bench_peers(lines.append, is_short=True, repeats=1)
    assert len(rows) + sum(line.startswith("no ") for line in lines) == 6
    for row in rows:
        assert row.error < 2e-6, row
        assert row.configs_per_s * row.times_slower == pytest.approx(rows[0].configs_per_s)


@pytest.mark.long
def test_gradient_figures(monkeypatch, capsys):
    monkeypatch.setitem(WORKS["W0"], "link__modes", 1)
    monkeypatch.setitem(WORKS["W0"], "control__modes", 1)
    monkeypatch.setattr("studies.bench.works.REPEATS", 1)
    cli.main(["bench", "--work", "grad", "--batch", "16", "--json"])
    found = json.loads(capsys.readouterr().out)["figures"]
    assert set(KEYS.split()) <= set(found)
    assert found["parameters"] == 3 and found["configs_per_s"] > 0 < found["fingerprint"]


#: One mode, one short move.
SHORT = {
    "link__modes": 1,
    "control__modes": 1,
    "run__duration": 0.05,
    "motion__waypoints": paper_study().motion.waypoints[:2],
    "motion__move_time": 0.03,
    "metrics__residual_delay": 0.0,
    "metrics__residual_length": 0.015,
}


def test_single_precision_is_measured_against_double(capsys):
    """Also where a thread of its own has no precision of its own, as the executor's."""
    command = ["bench", "--work", "W0", "--batch", "16", "--precision", "float32", "--json"]
    try:
        # not by monkeypatch: programs of this workload may be kept
        with patch.dict(WORKS["W0"], SHORT), patch("studies.bench.works.REPEATS", 1):
            cli.main(command)
    finally:
        jax.config.update("jax_enable_x64", True)
    found = json.loads(capsys.readouterr().out)["figures"]
    assert found["dtype"] == "float32"
    assert 1e-9 < found["error"]["residual_rms"] < 1


@pytest.mark.parametrize(
    "arguments", [["--work", "W2"], ["--work", "grad", "--executor", "tpu"], ["--batch", "-1"]]
)
def test_unknown_choices_are_refused(arguments, capsys):
    with pytest.raises(SystemExit, match="2"):
        cli.main(["bench", *arguments])
    assert "allowed" in capsys.readouterr().err
