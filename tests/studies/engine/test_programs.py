"""Programs kept on disk: found without being traced, and never mistaken for another."""

import runpy
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmodel.bases import find_bases
from jaxmodel.case import Structure
from jaxmodel.lazy import compiled
from jaxmodel.linear import linearise
from jaxmodel.prepare import prepare
from jaxmodel.sampled_loop import closed_loop
from jaxmodel.simulate import command, simulate
from studies import config, sources
from studies.engine import programs
from studies.engine.function import BlockFunction
from studies.engine.programs import kept_data, kept_jit
from studies.kernels import compilation
from studies.space.free import Placing

TRACED = []


def _scaled(structure, x, y):
    TRACED.append(structure)
    return {"sum": structure.n_modes * x + y, "root": jnp.linalg.cholesky(jnp.eye(2) * x[0])}


scaled = kept_jit(static_argnums=0)(_scaled)


@pytest.fixture
def keeping(tmp_path, monkeypatch):
    """A process that keeps its programs in a folder of its own, and the next process."""
    monkeypatch.setattr(compilation, "cache_folder", lambda: str(tmp_path))
    monkeypatch.setattr(programs, "is_keeping", lambda: True)
    TRACED.clear()

    def next_process():
        monkeypatch.setattr(programs, "_PROGRAMS", {})
        jax.clear_caches()

    next_process()
    return tmp_path, next_process


def test_the_next_process_does_not_trace(keeping):
    folder, next_process = keeping
    structure, x = Structure(), np.array([2.0, 3.0])
    first = scaled(structure, x, 1.0)
    assert len(TRACED) == 1 and len(list(folder.glob("program-*"))) == 1
    next_process()
    again = scaled(structure, x, 1.0)
    assert len(TRACED) == 1
    jax.tree.map(np.testing.assert_array_equal, first, again)
    np.testing.assert_array_equal(again["sum"], 8 * x + 1)
    np.testing.assert_allclose(again["root"], np.sqrt(2) * np.eye(2))
    # other numbers are served by the same program
    assert scaled(structure, x + 1, 2.0)["sum"].tolist() == [26.0, 34.0] and len(TRACED) == 1


def test_too_many_programs_are_dropped(keeping, monkeypatch):
    """A process of many tunings would otherwise end for want of memory mappings."""
    arguments = Structure(), np.ones(2), 1.0
    first, in_use = scaled(*arguments), scaled.program(*arguments)
    programs.drop_programs()
    assert programs._PROGRAMS
    monkeypatch.setattr(programs, "MOST_MAPPINGS", 0)
    monkeypatch.setattr(programs, "_STAYED", [0])
    programs.drop_programs()
    assert not programs._PROGRAMS
    for again in (in_use(*arguments[1:]), scaled(*arguments)):
        jax.tree.map(np.testing.assert_array_equal, first, again)


def test_programs_in_use_do_not_make_all_others_go_at_each_call(keeping, monkeypatch):
    cleared = []
    monkeypatch.setattr(programs, "_STAYED", [0])
    monkeypatch.setattr(programs, "_mappings", lambda: programs.MOST_MAPPINGS + 5)
    monkeypatch.setattr(programs.jax, "clear_caches", lambda: cleared.append(1))
    for _ in range(3):
        programs.drop_programs()
    assert cleared == [1]
    monkeypatch.setattr(programs, "_mappings", lambda: 2 * programs.MOST_MAPPINGS + 1)
    programs.drop_programs()
    assert cleared == [1, 1]


@pytest.mark.parametrize(
    "other",
    [
        (Structure(n_modes=4), np.ones(2), 1.0),
        (Structure(), np.ones(3), 1.0),
        (Structure(), np.ones(2, np.float32), 1.0),
        (Structure(), np.ones(2), np.float64(1.0)),
    ],
    ids=["structure", "shape", "type", "weak type"],
)
def test_what_differs_is_another_program(keeping, other):
    _, next_process = keeping
    scaled(Structure(), np.ones(2), 1.0)
    next_process()
    result = scaled(*other)
    assert len(TRACED) == 2
    assert result["sum"].shape == other[1].shape and result["sum"][0] == other[0].n_modes + 1


def test_other_flags_are_other_programs(keeping, monkeypatch):
    _, next_process = keeping
    arguments = Structure(), np.ones(2), 1.0
    scaled(*arguments)
    monkeypatch.setenv("XLA_FLAGS", "--another")
    next_process()
    scaled(*arguments)
    assert len(TRACED) == 2


@pytest.mark.parametrize("damage", [b"", b"nothing", None])
def test_damaged_entries_are_made_anew(keeping, damage):
    folder, next_process = keeping
    scaled(Structure(), np.ones(2), 1.0)
    (path,) = folder.glob("program-*")
    whole = path.read_bytes()
    path.write_bytes(whole[:-1] if damage is None else damage)
    next_process()
    assert scaled(Structure(), np.ones(2), 1.0)["sum"].tolist() == [9.0, 9.0]
    assert len(TRACED) == 2 and len(path.read_bytes()) > len(whole) // 2


def test_a_function_among_the_static_arguments_is_not_kept(keeping):
    folder, _ = keeping
    apply = kept_jit(static_argnums=0)(lambda function, x: function(x))
    assert apply(jnp.sin, 0.5) == pytest.approx(np.sin(0.5))
    assert not list(folder.glob("program-*"))


def _raised(n, x, _):
    TRACED.append(n)
    return x**n


def test_a_function_with_plain_arguments_given_is_kept(keeping):
    """As those that place free numbers."""
    _, next_process = keeping
    apply = kept_jit(static_argnums=0)(lambda placing, x, y: placing(x, y))

    def raised(x, n):
        return apply(Placing(_raised, (n,)), x, 0.0).tolist()

    assert raised(np.array([2.0]), 3) == [8.0] and raised(np.array([2.0]), 2) == [4.0]
    next_process()
    count = len(TRACED)
    assert raised(np.array([3.0]), 2) == [9.0] and raised(np.array([3.0]), 3) == [27.0]
    assert len(TRACED) == count == 2
    assert raised(np.array([3.0]), 4) == [81.0] and len(TRACED) == 3


def test_it_is_a_plain_jit_inside_other_programs(keeping):
    folder, _ = keeping
    x = jnp.arange(1.0, 7.0).reshape(3, 2)
    found = jax.vmap(lambda x: scaled(Structure(), x, 0.0)["sum"])(x)
    np.testing.assert_array_equal(found, 8 * x)
    assert jax.grad(lambda x: scaled(Structure(), x, 0.0)["sum"][0])(x[0]).tolist() == [8.0, 0.0]
    assert not list(folder.glob("program-*"))


def test_only_commands_keep_programs(tmp_path, monkeypatch):
    """A session of Python may change a module by hand, which no name would tell."""
    monkeypatch.setattr(compilation, "cache_folder", lambda: str(tmp_path))
    assert not programs.is_keeping()
    assert not runpy.run_path(config.__file__)["is_keeping"]()  # as it is before these tests
    scaled(Structure(n_modes=5), np.ones(2), 1.0)
    assert kept_data(["numbers"], lambda: 3, __name__) == 3
    assert not list(tmp_path.iterdir())


def users_of_programs(top):
    """Modules that keep programs, by what they import."""
    kept = {f"{programs.__name__}.{name}" for name in ("kept_jit", "program")}
    for package in sources.PACKAGES:
        for path in (top / package).rglob("*.py"):
            if kept & set(sources._imports(path)):
                yield ".".join(path.relative_to(top).with_suffix("").parts)


def test_a_word_in_a_report_leaves_all_programs_kept(tmp_path):
    """And a change of the physics none: by copies of the packages with a file changed."""
    for package in sources.PACKAGES:
        shutil.copytree(
            sources.TOP / package, tmp_path / package, ignore=shutil.ignore_patterns("__pycache__")
        )

    def digests():
        return {x: sources.digest(programs.__name__, x, top=tmp_path) for x in modules}

    def changed(name):
        path = tmp_path / name
        text = path.read_bytes()
        path.write_bytes(text + b"\n")
        found = digests()
        path.write_bytes(text)
        return {x for x in modules if found[x] != before[x]}

    modules = sorted(users_of_programs(tmp_path))
    before = digests()
    assert {"studies.engine.runs", "studies.engine.function", "studies.tuning.objective"} < {
        *modules
    }
    assert programs.environment("studies.engine.runs")[0] == before["studies.engine.runs"]
    reports = "studies/sweeps/say.py", "studies/show/words.py", "studies/show/page.html"
    for name in reports:
        assert not changed(name), name
    assert changed("jaxmodel/beam.py") == {*modules}


def test_functions_of_the_model_run_as_one_program():
    """Called with numbers, they are traced once; in a transformation they are its own part."""
    traced = []

    @compiled("structure", "is_held")
    def scaled(structure, x, is_held=False):
        traced.append(structure)
        return x * (2.0 if is_held else 3.0)

    assert [float(scaled(("a", 1), x)) for x in (1.0, 2.0)] == [3.0, 6.0]
    assert traced == [("a", 1)]
    assert float(scaled(("a", 1), 1.0, is_held=True)) == 2.0
    assert str(jax.make_jaxpr(lambda x: scaled(("b", 1), x))(1.0)).count("pjit") == 0
    assert float(jax.grad(lambda x: scaled(("b", 1), x))(1.0)) == 3.0
    for function in (prepare, closed_loop, simulate, command, linearise, find_bases):
        assert function.__wrapped__ and function.__doc__


def test_a_block_is_prepared_in_groups_also_with_empty_lists():
    block = object.__new__(BlockFunction)
    block.lanes = 16
    block._prepared = lambda axis, free, own, shared: [jnp.stack([own[0] + shared, own[0]])]
    (found,) = block.prepare((), [np.arange(16.0), np.zeros((16, 0))], 1.0)
    np.testing.assert_array_equal(found, [np.arange(16) + 1, np.arange(16)])
