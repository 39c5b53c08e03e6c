"""Exported controllers on emulated processors, and the project that builds them."""

import os
import re
import shutil
import struct
import subprocess
from types import SimpleNamespace
from unittest import mock

import numpy as np
import pytest

from studies.errors import StudyError
from studies.export import sequences
from studies.export.firmware import build as building
from studies.export.firmware import on_target, project
from studies.export.firmware.boards import BOARDS
from studies.export.firmware.build import (
    COMPILER,
    EMULATOR,
    STRICT,
    build,
    check_tools,
    stack_bound,
)
from studies.export.firmware.emulator import EmulatedCode, emulated
from studies.export.firmware.project import project_files, write_files
from studies.export.verify import Exchange
from tests.exports import DESIGNS, needs_compiler, needs_cpp, write_study
from tests.pages import tables_of, text_of
from tests.studies.test_cli import refused, run


@pytest.fixture(scope="module", autouse=True)
def short_sequences():
    with mock.patch.object(sequences, "LENGTH", 300):  # is part of no program: they are kept
        yield


def needs_target():
    """Skip the test where Arm's compiler or the emulator is missing."""
    needs_compiler()
    try:
        check_tools()
    except StudyError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    return write_study(tmp_path_factory.mktemp("study") / "paper.toml", DESIGNS["paper"])


def exported(capsys, study, out, target, board):
    needs_target()
    return run(capsys, "export", study, "--target", target, "--out", out, "--pil", board)


# --- without tools --------------------------------------------------------------------------------

GRAPH = r"""graph: { title: "flexlink.c"
node: { title: "flexlink_init" label: "flexlink_init\nflexlink.c:1:6\n8 bytes (static)\n0 dynamic" }
node: { title: "flexlink.c:check" label: "check\nflexlink.c:2:5\n16 bytes (static)\n0 dynamic" }
node: { title: "flexlink.c:forget" label: "forget\nflexlink.c:3:5\n24 bytes (static)\n0 dynamic" }
node: { title: "flexlink_step" label: "flexlink_step\nflexlink.c:4:5\n136 bytes (static)\n0" }
node: { title: "__aeabi_lmul" label: "__aeabi_lmul\n<built-in>" shape : ellipse }
edge: { sourcename: "flexlink_step" targetname: "flexlink.c:check" label: "flexlink.c:9:1" }
edge: { sourcename: "flexlink.c:check" targetname: "flexlink.c:forget" label: "flexlink.c:5:1" }
edge: { sourcename: "flexlink_step" targetname: "__aeabi_lmul" }
edge: { sourcename: "flexlink_init" targetname: "flexlink.c:forget" }
}"""


def test_the_stack_is_that_of_the_deepest_calls():
    assert stack_bound(GRAPH, "flexlink_step") == 136 + 16 + 24
    assert stack_bound(GRAPH, "flexlink_init") == 8 + 24


def test_demands_far_above_the_limit_count_as_rounded():
    """What an observer that is told of limits rounds is a share of its demands."""
    volts = np.full((4, 3, 3), 100.0)
    at = on_target.Comparison(None, None, "", BOARDS["cortex-m4f"], None, [], None)
    for largest, is_met in ((0.0, False), (1e4, True)):
        exchange = Exchange(volts, volts, largest)
        check = on_target._compare(at, "random", volts + 1.0, exchange)
        assert check.is_met == is_met


@pytest.mark.parametrize(
    "arguments, message",
    [
        (("--target", "c", "--pil", "cortex-m5"), "cortex-m4"),
        (("--target", "json", "--pil", "cortex-m4"), "not allowed with --target json"),
        (("--target", "c", "--pil", "cortex-m4", "--no-verify"), "--no-verify"),
    ],
)
def test_what_is_no_processor_is_refused(capsys, study, arguments, message, tmp_path):
    assert message in refused(capsys, "export", study, *arguments, "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_missing_tools_are_named_with_their_packages(capsys, study, tmp_path, monkeypatch):
    which = shutil.which
    names = (COMPILER, EMULATOR)
    monkeypatch.setattr(building.shutil, "which", lambda x: None if x in names else which(x))
    arguments = ("--target", "c", "--pil", "cortex-m4", "--out", tmp_path / "out")
    message = refused(capsys, "export", study, *arguments)
    assert EMULATOR in message and "packages gcc-arm-none-eabi" in message
    assert not (tmp_path / "out").exists()


# --- on the processor -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    "target, board",
    [
        ("c-fixed", "cortex-m4"),
        ("c", "cortex-m4f"),
        pytest.param("c-fixed", "cortex-m3", marks=pytest.mark.long),
        pytest.param("c-fixed", "cortex-m7", marks=pytest.mark.long),
        pytest.param("c", "cortex-m7", marks=pytest.mark.long),
        pytest.param("c", "cortex-m3", marks=pytest.mark.long),
    ],
)
def test_a_controller_on_a_processor(capsys, study, target, board, tmp_path):
    code, text, _ = exported(capsys, study, tmp_path / "out", target, board)
    assert code == 0, text
    report = (tmp_path / "out" / "verification.html").read_text()
    words = text_of(report)
    assert words.startswith("# Verification: passed") and "not cycles" in words
    (counts, loads) = tables_of(report)["On the processor"]
    assert "closed loop" in counts["sequence"] and len(counts["sequence"]) >= 6
    least, most = (np.array(counts[x], int) for x in ("instructions: least", "most"))
    assert np.all((least > 10) & (least <= most)) and most.max() < 20_000
    assert [x.split()[0] for x in loads["clock"]] == ["72", "168", "480"]
    if target == "c-fixed":
        for line in (
            r"closed loop \| 0 ADC codes and commands differ, residual equal",
            r"random input with faults .* \| 0 codes and faults differ",
            r"calls of floating-point routines \| none",
            r"shaper, the case's motion \| 0 counts differ",
        ):
            assert re.search(f"{board}: {line}", words)


def test_routines_that_fixed_point_must_not_call_are_named():
    at = SimpleNamespace(board=SimpleNamespace(name="M3"), is_fixed=True)
    found = [
        on_target._static_checks(at, SimpleNamespace(stack=100, soft_float=names))[-1]
        for names in ([], ["__aeabi_dmul", "__aeabi_dadd"])
    ]
    what = "M3: calls of floating-point routines"
    assert found[0] == (what, "none", "none", True)
    assert found[1] == (what, "__aeabi_dmul, __aeabi_dadd", "none", False)


@pytest.mark.long  # in short: the first board and 24,000 samples of each export
@pytest.mark.parametrize("board", ["cortex-m3", "cortex-m4", "cortex-m7"])
def test_fixed_point_is_the_same_on_all_processors(compared, board, monkeypatch):
    """210,000 samples with 35 faults and 70 resets, on x86 and on the target."""
    monkeypatch.setattr(sequences, "LENGTH", 3000)
    monkeypatch.setattr(on_target, "EPISODES", 70)
    found = on_target.verify_on_target(compared._replace(board=BOARDS[board]))
    assert failed(found) == {}
    assert len(found.instructions["random input with faults and resets"]) == 210_000


def test_instructions_of_a_sample_are_counted_from_ticks():
    """Of a program that answers one sample: 400 ticks, and a depth of 96 bytes."""
    answers = struct.pack("<6I 3f iII", 1, 4, 4, 8, 8, 1024, 1.0, 2.0, 3.0, 0, 400, 96)
    (there, to), (back, answer) = os.pipe(), os.pipe()
    os.write(answer, answers)
    code = EmulatedCode(SimpleNamespace(poll=lambda: 0), (to, back))
    values, fault = code.step(np.zeros((3, 1)))
    for pipe in (there, to, back, answer):
        os.close(pipe)
    assert (values.tolist(), fault, code.depth) == ([1.0, 2.0, 3.0], 0, 96)
    each = 2**7 * 1e-9 * 25e6  # ticks of 25 MHz in an instruction of 128 ns
    assert [x.tolist() for x in code.instructions] == [[1 + 400 / each]]


@pytest.fixture(scope="module")
def compared(study):
    """Arguments of a comparison in fixed point, and of the one on this machine."""
    needs_target()
    return on_target_arguments(study)


def on_target_arguments(study):
    from rich.console import Console

    from studies.engine.design import load_design
    from studies.export import targets

    captured = {}

    def keep(comparison):
        captured["at"] = comparison
        raise StudyError("kept")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(targets, "verify_on_target", keep)
        from studies.export.run import export_design

        with pytest.raises(StudyError, match="kept"):
            export_design(
                load_design(study, None),
                "c-fixed",
                study.parent / "none",
                console=Console(quiet=True),
                pil="cortex-m4",
            )
    return captured["at"]


def failed(found):
    return {check.what: check.found for check in found.checks if not check.is_met}


def test_a_wrong_shift_is_found(compared):
    code = compared.source.code
    wrong = code.replace("(int64_t)1 << (shift - 1)", "(int64_t)1 << (shift - 2)")
    assert wrong != code
    found = on_target.verify_on_target(
        compared._replace(source=compared.source._replace(code=wrong))
    )
    assert "cortex-m4: recorded codes" in failed(found)
    assert "cortex-m4: closed loop" in failed(found)


def test_a_stack_that_is_too_small_is_found(compared, monkeypatch):
    monkeypatch.setattr(project, "STACK", 192)
    found = on_target.verify_on_target(compared)
    assert "cortex-m4: runs to its end" in failed(found) and found.sizes is None


def test_a_program_that_hangs_is_ended(compared, monkeypatch):
    from studies.export.firmware import emulator

    monkeypatch.setattr(emulator, "PATIENCE", 1.0)
    code = compared.source.code.replace("state->fault = 0;", "for (;;) {}", 1)
    found = on_target.verify_on_target(
        compared._replace(source=compared.source._replace(code=code))
    )
    assert "no answer for 1 s" in failed(found)["cortex-m4: runs to its end"]


def built(compared, folder):
    files = project_files(compared.source, compared.name, compared.board, compared.is_fixed)
    write_files(files, folder)
    return build(folder, compared.name, compared.board, compared.is_fixed)


def test_instructions_are_those_of_a_trace(compared, tmp_path):
    """The timer's count against one line of QEMU's log for each instruction."""
    image = built(compared, tmp_path).image
    exchange = compared.verified.exchanges["random codes"].sensor[:6]
    log = tmp_path / "log"
    with emulated(image, compared.board) as processor:
        processor.respond(exchange)
        wanted = processor.instructions[-1]
    with emulated(image, compared.board, traced_to=log) as processor:
        processor.respond(exchange)
    address = symbols(image)
    lines = re.findall(r"Trace.*\[[0-9a-f]+/([0-9a-f]+)/", log.read_text())
    places = [int(line, 16) for line in lines]
    found = []
    for k, place in enumerate(places):
        if place == address["flexlink_step"] and places[k - 1] >> 1 != place >> 1:
            back = places[k - 1] + 2  # after the branch with link to a register
            found.append(places.index(back, k) - k)
    np.testing.assert_array_equal(found, wanted)


def symbols(image):
    """Addresses of functions and variables."""
    lines = subprocess.run(
        ["arm-none-eabi-nm", image], capture_output=True, text=True, check=True, timeout=60
    ).stdout.splitlines()
    return {line.split()[2]: int(line.split()[0], 16) & ~1 for line in lines}


@pytest.mark.parametrize("toolchain", ["gcc", "clang"])
def test_the_project_builds_by_its_readme(compared, toolchain, tmp_path):
    """From the folder alone, by the README's command; its program then answers as the other one."""
    for tool in ("cmake", "make", toolchain):
        if not shutil.which(tool):
            pytest.skip(f"no {tool} here")
    write_files(
        project_files(compared.source, compared.name, compared.board, compared.is_fixed), tmp_path
    )
    (command,) = re.findall(r"^cmake -S.*$", (tmp_path / "README.md").read_text(), re.MULTILINE)
    command = command.replace("toolchain-gcc", f"toolchain-{toolchain}")
    subprocess.run(command, shell=True, cwd=tmp_path, check=True, timeout=120, capture_output=True)
    assert {"samples", "timer_handler"} <= set(symbols(tmp_path / "build/flexlink_firmware.elf"))
    exchange = compared.verified.exchanges["random codes"]
    with emulated(tmp_path / "build/flexlink_pil.elf", compared.board) as processor:
        values, _ = processor.respond(exchange.sensor)
    np.testing.assert_array_equal(values, exchange.actuator)


def test_files_of_a_project_are_c_plus_plus_too(compared, tmp_path):
    needs_cpp()
    write_files(project_files(compared.source, "flexlink", compared.board, True), tmp_path)
    command = ["arm-none-eabi-g++", "-std=c++11", *compared.board.flags, "-Wall", "-Wextra"]
    for standard in ("c99", "c11"):
        flags = [COMPILER, *compared.board.flags, *STRICT, f"-std={standard}"]
        for file in ("main.c", "startup.c", "pil.c", "flexlink.c"):
            subprocess.run([*flags, "-fsyntax-only", file], cwd=tmp_path, check=True, timeout=60)
    subprocess.run(
        [*command, "-Werror", "-fsyntax-only", "-x", "c++", "flexlink.c"],
        cwd=tmp_path,
        check=True,
        timeout=60,
    )
