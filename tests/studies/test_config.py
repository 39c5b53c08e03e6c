"""Settings of JAX: in force under the tests, refused when wrong or late, none at import."""

import gc
import json
import os
import re
import subprocess
import sys
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmodel.control import left_inverse
from studies import config
from studies.config import (
    COMPILER_FLAGS,
    DEVICE_FLAG,
    GARBAGE,
    configure,
    info,
    is_backend_started,
    untested,
)
from studies.errors import CacheWarning, StudyError
from tests import TOP


def run(code, **environment):
    """Standard output, read as JSON, of `code` in a Python with no settings of ours."""
    clean = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=clean | environment,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_float64_and_flags_are_in_force():
    assert jnp.zeros(1).dtype == jnp.float64
    assert all(name in os.environ["XLA_FLAGS"] for name in (*COMPILER_FLAGS, DEVICE_FLAG))


def test_sums_over_large_batches_are_right():
    """Whole numbers, so exactly; half of them are wrong with jaxlib 0.10.2 without our flags."""
    matrix = jnp.eye(3)
    rows = np.zeros((2**15, 3))
    rows[:, 0] = np.arange(len(rows))
    squared = jax.jit(jax.vmap(lambda row: jnp.sum((matrix @ row) ** 2)))(rows)
    np.testing.assert_array_equal(squared, rows[:, 0] ** 2)


def test_pseudo_inverses_of_large_batches_are_right():
    """NaN with jaxlib 0.11.2 without our flags."""
    matrices = np.random.default_rng(0).normal(size=(512, 3, 3, 3))
    found = jax.jit(jax.vmap(lambda x: left_inverse(x, np.ones(3))))(matrices)
    np.testing.assert_allclose(found, np.linalg.pinv(matrices), rtol=1e-6, atol=1e-6)


def test_garbage_is_looked_for_less_often_unless_the_user_has_a_say():
    before = gc.get_threshold()
    assert before == GARBAGE
    gc.disable()  # nothing is to be collected while the thresholds are low
    try:
        for given, wanted in (((700, 10, 10), GARBAGE), ((900, 5, 5), (900, 5, 5))):
            gc.set_threshold(*given)
            configure()
            assert gc.get_threshold() == wanted
    finally:
        gc.set_threshold(*before)
        gc.enable()


def test_equal_settings_may_be_repeated_after_the_start():
    jax.block_until_ready(jnp.ones(2) + 1)
    assert is_backend_started()
    before = os.environ["XLA_FLAGS"]
    configure()
    configure(devices=jax.local_device_count("cpu"))
    assert os.environ["XLA_FLAGS"] == before


def test_a_process_forked_after_the_start_is_refused_with_the_cure():
    """It would wait for threads that only the other has."""
    jnp.zeros(1).block_until_ready()
    config.require_configured()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # JAX and Python say that forking is unsafe
        child = os.fork()
    if child == 0:
        try:
            config.require_configured()
        except StudyError as error:
            os._exit(42 if 'get_context("spawn")' in str(error) else 1)
        os._exit(2)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 42


def test_late_devices_are_refused_with_the_cure():
    count = len(jax.local_devices(backend="cpu"))
    with pytest.raises(StudyError, match=rf"too late.*\(it has {count}\).*restart the kernel"):
        configure(devices=count + 1)


def test_late_flags_are_refused_with_the_cure(monkeypatch):
    jax.devices()
    monkeypatch.setenv("XLA_FLAGS", "")
    with pytest.raises(StudyError, match=r"too late.*xla_cpu.*configure\(flags=False\)"):
        configure()
    configure(flags=False)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (
            {"precision": "float46"},
            "precision = 'float46'; allowed: float64 or float32; did you mean 'float64'?",
        ),
        ({"devices": 0}, "devices = 0; allowed: a whole number from 1"),
        ({"devices": 1.5}, "devices = 1.5; allowed: a whole number from 1"),
    ],
)
def test_wrong_values_are_named(settings, words):
    with pytest.raises(StudyError) as caught:
        configure(**settings)
    assert str(caught.value) == words


def test_import_sets_nothing_and_configure_does(tmp_path):
    """Also: settings made after `import jax` count, and other settings of the user are kept."""
    seen = run(
        "import json, os, jax\n"
        "import jax.numpy as jnp\n"
        "import studies.config as config\n"
        "untouched = [os.environ['XLA_FLAGS'], jax.config.jax_enable_x64,\n"
        "             jax.config.jax_compilation_cache_dir, config.is_backend_started()]\n"
        "try:\n    config.require_configured()\n"
        "except config.StudyError as error:\n    untouched.append(str(error)[:40])\n"
        "config.configure('float32', devices=3)\n"
        "config.configure('float32', devices=3)\n"
        "started = config.is_backend_started()\n"
        "jax.config.update('jax_persistent_cache_min_compile_time_secs', 0)\n"
        "jax.jit(jnp.sin)(0.5).block_until_ready()\n"
        "print(json.dumps([untouched, started, os.environ['XLA_FLAGS'], os.environ['NPROC'],\n"
        "                  os.environ[config.LOG_LEVEL[0]], config.info()]))\n",
        XLA_FLAGS=f"--xla_cpu_prefer_vector_width=256 {DEVICE_FLAG}=2",
        XDG_CACHE_HOME=str(tmp_path),
        JAX_COMPILATION_CACHE_DIR="",
        NPROC="2",
        **{config.LOG_LEVEL[0]: "2"},
    )
    untouched, started, flags, threads, level, facts = seen
    *untouched, refusal = untouched
    assert untouched == [f"--xla_cpu_prefer_vector_width=256 {DEVICE_FLAG}=2", False, "", False]
    assert refusal == "studies.configure() must be called first"
    assert started is False and level == "2"
    width, *others = COMPILER_FLAGS
    added = [f"{name}={COMPILER_FLAGS[name]}" for name in others]
    assert flags.split() == [f"{width}=256", *added, f"{DEVICE_FLAG}=3"]
    # factorisations side by side never finish with few threads
    assert int(threads) == max(64, 4 * config.usable_cores())
    assert facts["devices"].startswith("3 x ")
    assert facts["precision"] == "float32"
    assert facts["cache"] == str(tmp_path / "flexlink-studies")
    assert any((tmp_path / "flexlink-studies").iterdir())


#: XLA cannot write there, which it logs as it logs the alarm; JAX's own failures are exceptions.
STARTING = """
import json, sys
from studies import config
from studies.cli import main
assert "jax" not in sys.modules
try:
    main(["info"])
except SystemExit as end:
    print(end.code, file=sys.stderr)
import jax
jax.config.update("jax_platforms", None)
config.start()
try:
    jax.jit(lambda x: jax.pure_callback(lambda x: 1 / 0, x, x))(1.0).block_until_ready()
except jax.errors.JaxRuntimeError as error:
    print(json.dumps(["ZeroDivisionError" in str(error), config.info()["cache"]]), flush=True)
"""


@pytest.mark.parametrize(
    ("level", "is_logged"), [(None, False), pytest.param("0", True, marks=pytest.mark.long)]
)
def test_what_stops_jax_is_said_and_its_log_is_not(tmp_path, level, is_logged):
    """An accelerator that is not there, for one; a cache folder that is none stops nothing.

    The log, in which XLA asks for bug reports, is there for those who ask for it.
    """
    (tmp_path / "file").write_text("")
    names = ("XLA_FLAGS", config.LOG_LEVEL[0])  # importing JAX has set the latter here
    clean = {name: value for name, value in os.environ.items() if name not in names}
    clean["XLA_FLAGS"] = "--xla_dump_to=/proc/none"
    clean["JAX_PLATFORMS"] = "nonsense"
    clean["JAX_COMPILATION_CACHE_DIR"] = str(tmp_path / "file" / "cache")
    done = subprocess.run(
        [sys.executable, "-c", STARTING],
        env=clean if level is None else clean | {config.LOG_LEVEL[0]: level},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert (done.returncode, json.loads(done.stdout)) == (0, [True, "none"]), done.stderr
    said, code, *logged = done.stderr.splitlines()
    assert said.startswith("studies: JAX cannot start: ") and code == "2"
    assert "JAX_PLATFORMS='nonsense'" in said
    assert ("Could not create directory" in "".join(logged)) == is_logged


@pytest.mark.parametrize(
    ("mode", "others", "said"),
    [
        (0o777, False, "can be written by others, who could run code through it; `chmod go-w"),
        (0o770, False, "can be written by others"),
        (0o755, True, "belongs to another user, who could run code through it; name one of your"),
        (0o755, False, ""),
    ],
)
def test_a_cache_folder_of_others_is_not_used(tmp_path, monkeypatch, mode, others, said):
    folder = tmp_path / "cache"
    folder.mkdir()
    folder.chmod(mode)
    if others:
        monkeypatch.setattr(config.os, "getuid", lambda: folder.stat().st_uid + 1)
    before = config.cache_folder()
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(folder))
    try:
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            configure()
        assert config.cache_folder() == ("" if said else str(folder))
        assert said in "".join(str(x.message) for x in told)
        assert [x.category for x in told] == ([CacheWarning] if said else [])
    finally:
        monkeypatch.undo()
        configure()
    assert config.cache_folder() == before


def test_info_is_plain_and_complete():
    facts = info()
    assert facts["jax"] == jax.__version__ and facts["precision"] == "float64"
    assert {
        "flexlink-studies",
        "python",
        "jaxlib",
        "numpy",
        "h5py",
        "devices",
        "cache",
        "xla_flags",
    } <= facts.keys()
    json.dumps(facts)


def test_versions_that_were_never_tested_are_named(monkeypatch):
    assert untested() == "none" == info()["untested_versions"]
    version = config._version
    monkeypatch.setattr(config, "_version", lambda x: "0.11.1" if x == "jax" else version(x))
    assert untested() == "jax 0.11.1 (tested: 0.10, 0.12)"
    monkeypatch.setattr(config, "_version", lambda _: config._ABSENT)
    monkeypatch.setattr(config.platform, "python_version", lambda: "3.14.0")
    assert untested() == "python 3.14.0 (tested: 3.11, 3.12, 3.13)"


def test_versions_tested_are_those_that_are_installed():
    """The constraints install a tested version on every Python, and the bounds admit no newer."""
    text = (TOP / "constraints.txt").read_text(encoding="utf-8")
    for name in config.TESTED.keys() - {"python"}:
        pinned = set(re.findall(rf"^{name}==(\d+\.\d+)", text, re.MULTILINE))
        assert pinned == set(config.TESTED[name]), name
    project = (TOP / "pyproject.toml").read_text(encoding="utf-8")
    for name, bound in (
        ("python", r'requires-python = ".*<3\.(\d+)"'),
        ("jax", r'"jax>=.*<0\.(\d+)"'),
    ):
        newest = config.TESTED[name][-1]
        assert int(re.search(bound, project)[1]) == int(newest.split(".")[1]) + 1
