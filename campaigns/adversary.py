"""Exported code under attack: a search for the input that drives it farthest, misuse, interrupts.

The programs are in `tests/data`: `adversary.c` searches, and what it finds is computed again by the
models; `misuse.c` omits and repeats calls and interrupts them; `nested.c` does so on a processor.
"""

import subprocess
from functools import cache
from typing import NamedTuple

import numpy as np

from studies.export.c_fixed import fixed_source
from studies.export.c_floating import floating_source
from studies.export.c_text import Source
from studies.export.compiler import STRICT
from studies.export.firmware import build as firmware
from studies.export.firmware.boards import BOARDS
from studies.export.firmware.project import project_files, write_files
from studies.export.fixed import FixedPoint, rail_samples
from studies.export.fixed_blocks import FixedBlocks, design_integers
from studies.export.floating import respond as respond_floating
from studies.export.integers import respond
from tests import DATA
from tests.exports import KINDS, PAPER, SINGLE, changed, found_and_codes

#: Every kind of controller: channels, rivals, blocks that know of limits and those that do not.
DESIGNS = {
    **KINDS,
    "feed-through of 12 bits": changed(SINGLE, electronics={"adc_bits": 12}),
    "modified imsc": changed(PAPER, control={"law": "modified_imsc"}),
    "lqg": changed(PAPER, control={"law": "lqg"}),
    "observer": changed(PAPER, control={"law": "observer"}),
}
#: Types of a word of the state.
WORDS = ("double", "float", "int32_t", "int16_t")
#: Differences from the model in double precision, as shares of the limit.
CLOSE = {"double": 1e-12, "float": 1e-4}
#: Compilers, and more sanitizers for exported code, in which not even unsigned words may wrap.
COMPILERS = {"gcc": "", "clang": "integer"}
MORE_WARNINGS = ("-Wconversion", "-Wsign-conversion", "-Wshadow", "-Wstrict-prototypes")


class Victim(NamedTuple):
    """Exported code, with its models."""

    found: object  # the controller
    word: str  # type of its state's words
    fixed: FixedPoint | FixedBlocks  # also the bounds of code in floating point
    source: Source

    @property
    def is_fixed(self):
        return self.word.startswith("int")

    @property
    def limit(self):
        """Largest actuator value: volts, or codes from rest."""
        if self.is_fixed:
            return self.fixed.wires.dac_rest - 1
        return float(self.found.controller.voltage_limit)

    @property
    def flags(self):
        """What the programs in `tests/data` are told."""
        used = sum(1 << int(i) for i in set(self.found.channels.link))
        rest = round(self.fixed.wires.bias / 2**self.fixed.wires.adc_bits)
        flags = [f"-DCOUNT={self.word}", f"-DUSED={used}", f"-DREST={rest}", f"-DBACK={self.back}"]
        own = {"float": "-DFLEXLINK_REAL=float", "double": "-DFLEXLINK_REAL=double"}
        return [*flags, own.get(self.word, "-DFIXED")]

    @property
    def back(self):
        """How far apart two controllers may stay whose sensors have come to rest."""
        if self.is_fixed:  # each may keep its own rounding errors
            return 1 + int(2 * self.fixed.error.rounding.max() / self.fixed.wires.dac_step)
        return self.limit * CLOSE[self.word]


@cache
def _prepared(name):
    """A design's controller, and its signals in a motion."""
    found, codes = found_and_codes(DESIGNS[name])
    return found, respond_floating(found.channels, found.controller, codes)


def victim(name, word):
    """A design of `DESIGNS` in an arithmetic of `WORDS`."""
    found, seen = _prepared(name)
    fixed, _ = design_integers(found, seen, 12, 16 if word == "int16_t" else 32)
    if word.startswith("int"):
        source = fixed_source(found, fixed, "flexlink", [name], "")
    else:
        source = floating_source(found, "flexlink", [name])
    return Victim(found, word, fixed, source)


def build(at, program, command, folder, strict=()):
    """A program of `tests/data` with the exported code, compiled by a command with its flags.

    Args:
        at: a `Victim`.
        program: name of its file.
        command: compiler and flags of both.
        folder: where.
        strict: flags of the exported code alone.
    """
    (folder / "flexlink.h").write_text(at.source.header)
    (folder / "flexlink.c").write_text(at.source.code)
    made, command = folder / program, [*command, *at.flags, "-I", folder]
    steps = (
        [*command, *STRICT, *MORE_WARNINGS, *strict, "-c", "-o", folder / "flexlink.o"]
        + [folder / "flexlink.c"],
        [*command, "-std=gnu99", "-Wall", "-Wextra", "-Werror", "-o", made]
        + [DATA / f"{program}.c", folder / "flexlink.o", "-lm"],
    )
    for step in steps:
        subprocess.run(step, check=True, timeout=300)
    return made


def called(program, *arguments):
    """What a program prints; it must end well.

    Raises:
        AssertionError: it does not; with what it says.
    """
    words = [program, *map(str, arguments)]
    done = subprocess.run(words, capture_output=True, text=True, check=False, timeout=1200)
    assert done.returncode == 0, done.stdout + done.stderr[-3000:]
    return done.stdout


class Found(NamedTuple):
    """Results of a search."""

    samples: int
    codes: np.ndarray  # sequences side by side, (T, E, n, K)
    actuators: np.ndarray  # of the code, (T, E, n, K)
    largest: np.ndarray  # of each word of the state


def search(program, at, samples, seed, length):
    """Attack a program from `build`, with sequences of so many samples."""
    file = program.with_suffix(".found")
    words = called(program, samples, seed, length, file).split()
    n, k = at.found.n_links, at.found.n_patches
    rows = np.fromfile(file).reshape(-1, length, 2, n, k)[:, ::-1].swapaxes(0, 1)
    return Found(int(words[0]), rows[:, :, 0], rows[:, :, 1], np.array(words[1:], float))


def check_models(at, found):
    """The code does what its models do along what was found: bit by bit in fixed point."""
    rail = rail_samples(at.found.study.electronics.sample_rate_hz)
    if at.is_fixed:
        response = respond(at.fixed, found.codes, rail)
        np.testing.assert_array_equal(found.actuators, response.codes)
        assert response.limited.sum() == 0 and not response.is_faulty.any()
        return
    wanted = respond_floating(at.found.channels, at.found.controller, found.codes).command
    assert np.abs(found.actuators - wanted).max() <= CLOSE[at.word] * at.limit


def reached(at, found):
    """Largest words of what can be bounded, as shares of their bounds."""
    if isinstance(at.fixed, FixedBlocks):
        form, words = at.fixed.state, found.largest.reshape(at.fixed.state.bound.shape)
    else:
        form, words = at.fixed.inner, found.largest.reshape(3, -1)[1:].reshape(-1, 2).max(axis=1)
    return words * (form.step if at.is_fixed else 1.0) / form.bound


def attack(at, samples, seed, length, command, folder, strict=()):
    """Build, search and check; see `build` and `search`. Returns what was found."""
    found = search(build(at, "adversary", command, folder, strict), at, samples, seed, length)
    check_models(at, found)
    assert reached(at, found).max() <= 1 + {"int16_t": 1e-2, "float": 1e-5}.get(at.word, 1e-6)
    return found


def nest(at, board, folder):
    """Exit status of `nested.c` on an emulated processor."""
    files = project_files(at.source, "flexlink", BOARDS[board], at.is_fixed)
    files["main.c"] = "#define FIXED\n" * at.is_fixed + (DATA / "nested.c").read_text()
    files["exported.h"] = (DATA / "exported.h").read_text()
    write_files(files, folder)
    firmware.build(folder, "flexlink", BOARDS[board], at.is_fixed)
    command = [
        *(firmware.EMULATOR, "-machine", BOARDS[board].machine, "-display", "none"),
        *("-monitor", "none", "-serial", "none", "-icount", "shift=7,sleep=off"),
        *("-semihosting-config", "enable=on,target=native", "-kernel", folder / "main.elf"),
    ]
    return subprocess.run(command, stdin=subprocess.DEVNULL, timeout=120).returncode
