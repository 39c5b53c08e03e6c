"""The table of `make gpu`; the command itself takes minutes."""

import importlib.util

import pytest

from tests import TOP


@pytest.fixture
def gpu(tmp_path, monkeypatch):
    spec = importlib.util.spec_from_file_location("gpu", TOP / ".ci" / "gpu.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.setattr(module, "PAGE", tmp_path / "page.md")
    return module


def test_the_page_has_its_marks(gpu):
    text = (TOP / "docs" / "performance.md").read_text(encoding="utf-8")
    assert [text.count(mark) for mark in gpu.MARKS] == [1, 1]


def test_a_table_of_cores_does_not_replace_that_of_a_gpu(gpu):
    gpu.PAGE.write_text(f"above\n{gpu.MARKS[0]}\n{gpu.STAND_IN}\n\n{gpu.MARKS[1]}below\n")
    assert gpu.write(["| | H200 | 16 cores |", "| W0 | 2 | 1 |"])
    written = gpu.PAGE.read_text()
    assert written == (
        f"above\n{gpu.MARKS[0]}\n| | H200 | 16 cores |\n| W0 | 2 | 1 |\n\n{gpu.MARKS[1]}below\n"
    )
    assert not gpu.write([f"| | {gpu.STAND_IN} | 2 cores |"])
    assert gpu.PAGE.read_text() == written


def test_differences_of_both_sides(gpu):
    one, other = gpu.Done("1", [1.0, 4.0]), gpu.Done("2", [1.0, 5.0])
    assert gpu.difference(one, other) == 0.2
    assert gpu.difference(one, gpu.Done("failed")) is None


def test_both_sides_measure_the_same_works(gpu, monkeypatch):
    asked = []
    monkeypatch.setattr(gpu, "run", lambda *a: asked.append(a) or ("", "failed"))
    lines, agree = gpu.measure("", 0.0)
    assert agree and len(lines) == 2 + len(gpu.WORKS) + 3
    assert [is_gpu for _, is_gpu, _ in asked] == [True, False] * (len(gpu.WORKS) + 3)
    assert all("failed | failed" in line for line in lines[2:])
