"""Exported code withstands the worst input that a search finds, misuse and interrupts."""

import shutil
import subprocess

import pytest

from campaigns import adversary
from campaigns.adversary import COMPILERS, DESIGNS, WORDS, attack, build, called, nest, victim
from studies.errors import StudyError
from studies.export import fixed as fixed_point
from studies.export.firmware.build import check_tools
from tests.exports import needs_sanitizers

#: Samples of the full campaign with each compiler.
MANY = 10_000_000


def sanitizing(compiler, folder):
    """Command of a compiler with sanitizers, and flags of exported code."""
    kinds, more = "address,undefined", COMPILERS[compiler]
    needs_sanitizers(folder, [compiler], f"{kinds},{more}".strip(","))
    flags = ["-O1", "-g", f"-fsanitize={kinds}", "-fno-sanitize-recover=all"]
    return [compiler, *flags], [f"-fsanitize={more}", "-fno-sanitize-recover=all"] if more else []


def plain(compiler, *flags):
    """Command of a compiler without sanitizers."""
    if not shutil.which(compiler):
        pytest.skip(f"no {compiler} here")
    return [compiler, *flags]


def changed(at, old, new):
    """Its code with something else in it."""
    assert old in at.source.code
    return at._replace(source=at.source._replace(code=at.source.code.replace(old, new)))


@pytest.mark.parametrize(
    "name, word, compiler",
    [
        ("paper", "int32_t", "clang"),
        ("feed-through", "float", "clang"),
        ("modified imsc", "int16_t", "gcc"),
        ("lqg", "int32_t", "gcc"),
        ("modified imsc", "double", "gcc"),
    ],
)
def test_the_search_finds_nothing(name, word, compiler, tmp_path):
    command, strict = sanitizing(compiler, tmp_path)
    at = victim(name, word)
    found = attack(at, 20_000, 0, 150, command, tmp_path, strict)
    assert found.samples >= 20_000


@pytest.mark.long
@pytest.mark.parametrize("compiler", COMPILERS)
@pytest.mark.parametrize("word", WORDS)
def test_the_long_search_finds_nothing(word, compiler, tmp_path):
    """All designs; ten million samples with each compiler in all."""
    command, strict = sanitizing(compiler, tmp_path)
    most = MANY // (len(WORDS) * len(DESIGNS)) + 1
    samples, n_refused = 0, 0
    for name in DESIGNS:
        try:
            at = victim(name, word)
        except StudyError as error:
            assert "allowed" in str(error)
            n_refused += 1
            continue
        samples += attack(at, 2 * most, len(name), 300, command, tmp_path, strict).samples
    assert n_refused <= 1 and samples >= MANY / len(WORDS)


def test_the_search_nears_the_bound(tmp_path):
    """What no sequence of codes can exceed, the search nearly reaches."""
    at = victim("paper", "int32_t")
    found = attack(at, 300_000, 0, 300, plain("gcc", "-O2"), tmp_path)
    assert adversary.reached(at, found).max() > 0.95


def test_the_search_sees_words_that_are_too_short(tmp_path, monkeypatch):
    """A format with room for what the motion needs, but not for the worst sequence."""
    found_format = fixed_point.find_format

    def short(seen, bound, word):
        return found_format(seen, 0.4 * bound, word)

    monkeypatch.setattr(fixed_point, "find_format", short)
    at = victim("paper", "int32_t")
    with pytest.raises(AssertionError, match="overflow of word"):
        attack(at, 300_000, 0, 300, plain("gcc", "-O2"), tmp_path)


@pytest.mark.parametrize(
    "word, old, new, what",
    [
        ("int32_t", "state->fault = check(", "k = check(", "another fault than expected"),
        ("int32_t", "const int64_t most = DAC_REST - 1", "const int64_t most = DAC_REST", "beyond"),
        ("double", "if (!(sensor[k] >= -ADC_STEP &&", "if (!(sensor[k] > 1 ||", "expected|finite"),
        ("double", "state->line[k][1] = 0;", "", "there is a rest in word"),
        ("float", "state->high[m] = HIGH_PASS", "state->high[m] += HIGH_PASS", "finite|come back"),
    ],
)
def test_the_search_sees_faults(word, old, new, what, tmp_path):
    at = changed(victim("paper", word), old, new)
    with pytest.raises(AssertionError, match=what):
        attack(at, 300_000, 0, 150, plain("gcc", "-O2"), tmp_path)


def misuse(at, command, folder, samples, interrupts, strict=()):
    program = build(at, "misuse", command, folder, strict)
    said = called(program, samples, interrupts, 1)
    assert said == f"{2 * interrupts} interrupts in the middle of a step\n"


@pytest.mark.parametrize(
    "name, word, compiler",
    [("feed-through of 12 bits", "int16_t", "gcc"), ("lqg", "float", "clang")],
)
def test_misuse_breaks_nothing(name, word, compiler, tmp_path):
    """No init, init twice, two instances at once, interrupts in the middle of a step."""
    command, strict = sanitizing(compiler, tmp_path)
    misuse(victim(name, word), command, tmp_path, 3000, 1000, strict)


@pytest.mark.long
@pytest.mark.parametrize("compiler", COMPILERS)
@pytest.mark.parametrize("name", sorted(DESIGNS))
def test_much_misuse_breaks_nothing(name, compiler, tmp_path):
    command, strict = sanitizing(compiler, tmp_path)
    for word in WORDS:
        if (name, word) != ("feed-through", "int16_t"):  # refused: 16-bit codes
            misuse(victim(name, word), command, tmp_path, 20_000, 10_000, strict)


#: What makes a function that must not be interrupted by itself.
SHARED = ("    int32_t sensed[", "    static int32_t sensed[")


def test_an_instance_that_shares_memory_is_seen(tmp_path):
    at = changed(victim("paper", "int32_t"), *SHARED)
    with pytest.raises(AssertionError, match="interrupted: other samples"):
        misuse(at, plain("gcc", "-O1"), tmp_path, 3000, 20_000)


def needs_target():
    """Skip the test where Arm's compiler or the emulator is missing."""
    try:
        check_tools()
    except StudyError as error:
        pytest.skip(str(error))


@pytest.mark.parametrize(
    "name, word, board",
    [
        ("paper", "int32_t", "cortex-m4"),
        ("paper", "float", "cortex-m4f"),
        pytest.param("lqg", "int32_t", "cortex-m3", marks=pytest.mark.long),
        pytest.param("lqg", "double", "cortex-m7", marks=pytest.mark.long),
        pytest.param("feed-through", "float", "cortex-m3", marks=pytest.mark.long),
        pytest.param("modified imsc", "int16_t", "cortex-m4", marks=pytest.mark.long),
    ],
)
def test_interrupts_on_a_processor_call_another_instance(name, word, board, tmp_path):
    needs_target()
    assert nest(victim(name, word), board, tmp_path) == 0


def test_an_instance_that_shares_memory_is_seen_on_a_processor(tmp_path):
    needs_target()
    assert nest(changed(victim("paper", "int32_t"), *SHARED), "cortex-m4", tmp_path) == 1


#: Options of both compilers that keep every bit, and options that round otherwise.
EXACT = ("-O0", "-O1", "-O2", "-O3", "-Os")
ROUNDED = (
    "-O3 -march=native",
    "-O2 -funsafe-math-optimizations",
    "-ffast-math -fno-finite-math-only",
)
REFUSED = ("-ffast-math", "-Ofast", "-ffinite-math-only")


def results(at, option, folder, compiler, samples=30_000):
    """Sequences and actuators of a search, as bytes; the models are compared as well."""
    attack(at, samples, 3, 150, plain(compiler, *option.split()), folder)
    return (folder / "adversary.found").read_bytes()


def test_levels_of_optimisation_give_the_same_bits(tmp_path):
    at = victim("paper", "double")
    assert results(at, "-O0", tmp_path, "gcc") == results(at, "-O2", tmp_path, "clang")


@pytest.mark.long
@pytest.mark.parametrize("word", WORDS)
@pytest.mark.parametrize("name", ["paper", "feed-through", "modified imsc", "lqg"])
def test_options_of_compilers(name, word, tmp_path):
    """Equal bits where the compiler may not round otherwise, always in fixed point."""
    if (name, word) == ("feed-through", "int16_t"):
        pytest.skip("refused: 16-bit codes")
    at = victim(name, word)
    options = EXACT + (REFUSED if at.is_fixed else ())
    found = {results(at, x, tmp_path, c) for c in ("gcc", "clang") for x in options}
    assert len(found) == 1
    for option in ROUNDED:
        for compiler in ("gcc", "clang"):
            results(at, option, tmp_path, compiler)


@pytest.mark.parametrize("option", REFUSED)
@pytest.mark.parametrize("compiler", ["gcc", "clang"])
def test_options_without_nan_are_refused_in_floating_point(option, compiler, tmp_path):
    at = victim("paper", "double")
    with pytest.raises(subprocess.CalledProcessError):
        build(at, "adversary", plain(compiler, option), tmp_path)
