"""Coverage-guided fuzzing of everything that is read from outside.

    pip install 'atheris>=3'        # Python 3.11 to 3.13, beside the package
    python -m campaigns.fuzz SECONDS FOLDER [TARGET ...]

divides the time among the targets (default: all). FOLDER keeps, for each target, the inputs that
reached new lines of `studies` (`TARGET/corpus`), from which a later run starts, and one input per
place that raised anything but a `StudyError` (`TARGET/faults`, with its traceback). Inputs that
take longer than 20 s or more than 4 GiB are kept by libFuzzer under `TARGET/`. Exits with 1 if
there is any. Mend the fault and make its input an ordinary test, as in
`tests/studies/test_fuzzed.py`.
"""

import importlib
import json
import re
import subprocess
import sys
import time
import tomllib
import traceback
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from tempfile import mkdtemp
from typing import NamedTuple

import numpy as np

#: Limits of one input [s], [MiB], [bytes].
TIME, MEMORY, SIZE = 20, 4096, 8192
#: Targets of files that are not text.
BINARY = ("system", "table")
#: Instrumented and imported before anything is read.
MODULES = (
    *("commission.spec", "engine.design", "engine.results", "engine.folder", "export.document"),
    *("fitting.spec", "fitting.tables", "space.condition", "space.table", "space.spec"),
    *("study.entries", "study.paths", "study.signals", "study.spec", "study.state_space"),
    *("sweeps.show", "tuning.objective", "tuning.spec"),
)
PACKAGE = Path(__file__).parents[1] / "studies"
#: Words for the dictionary of text inputs, beside the names of fields.
WORDS = (
    *("[sweep]", "[sweep.axes]", "[tune]", "[tune.free]", "[fit]", "[[fit.data]]", "[commission]"),
    *("from", "to", "count", "scale", "log", "method", "where", "nan", "inf", "true", "false"),
    *("[link=1]", "[mode=2]", "[0]", "not ", " and ", " or ", " in ", "abs(", "min(", "max(", "**"),
    *('"', "'", "[[", "]]", "{", "}", " = ", "-1", "0.0", "1e308", "\\ud800", "\\u001b"),
)


class Target(NamedTuple):
    """Something that reads bytes."""

    seeds: Callable[[], list[bytes]]
    make: Callable[[Path], Callable[[bytes], object]]  # a reader that may write into a folder


# --- targets --------------------------------------------------------------------------------------


def files(*keys: str) -> list[bytes]:
    """Ready-made files with one of these sections; none: studies."""
    found = {path: tomllib.loads(path.read_text()) for path in (PACKAGE / "specs").glob("*.toml")}
    special = {"sweep", "tune", "fit"}
    return [
        path.read_bytes()
        for path, data in sorted(found.items())
        if special & set(data) == set(keys)
    ]


def toml_target(parse: Callable[[dict, Path], object]) -> Callable:
    def make(folder: Path) -> Callable[[bytes], object]:
        from studies.study.files import read_toml

        def read(content: bytes) -> object:
            (folder / "x.toml").write_bytes(content)
            return parse(read_toml(folder / "x.toml"), folder)

        return read

    return make


def parse_study(data: dict, folder: Path) -> None:
    from studies.study.spec import parse_study

    study = parse_study(data)
    assert parse_study(study.model_dump()) == study, "a study that does not survive writing"


def parse_sweep(data: dict, folder: Path) -> None:
    from studies.space.spec import parse_sweep
    from studies.space.table import build_table

    spec = parse_sweep(data)
    if spec.sweep.count < 100 and spec.sweep.repeats < 10:
        build_table(spec)


def parse_tuning(data: dict, folder: Path) -> None:
    from studies.tuning.spec import parse_tuning

    parse_tuning(data)


def parse_fit(data: dict, folder: Path) -> None:
    from studies.fitting.spec import parse_fit

    parse_fit(data, folder)


def parse_measured(data: dict, folder: Path) -> None:
    from studies.commission.spec import parse_measured

    parse_measured(data, folder)


def controllers() -> list[bytes]:
    from campaigns.mutations import bare_gains

    return [path.read_bytes() for path in bare_gains(Path(mkdtemp()))]


def controller_reader(folder: Path) -> Callable[[bytes], object]:
    from studies.export.document import read_document

    def read(content: bytes) -> object:
        (folder / "x.json").write_bytes(content)
        return read_document(folder / "x.json")

    return read


def named(make: Callable[[Path], list[Path]], *endings: str) -> Callable[[], list[bytes]]:
    """Originals of a kind of file; the first byte says which ending it has."""

    def seeds() -> list[bytes]:
        found = make(Path(mkdtemp()))
        return [
            bytes([endings.index(path.suffix)]) + path.read_bytes()
            for path in found
            if path.suffix in endings
        ]

    return seeds


def reader_of(read: Callable[[Path], object], *endings: str) -> Callable:
    def make(folder: Path) -> Callable[[bytes], object]:
        def go(content: bytes) -> object:
            if not content:
                return None
            path = folder / f"x{endings[content[0] % len(endings)]}"
            path.write_bytes(content[1:])
            return read(path)

        return go

    return make


def systems() -> list[bytes]:
    from campaigns.mutations import controllers, matlab_files

    endings = ".json", ".npz", ".mat"
    return [x for make in (controllers, matlab_files) for x in named(make, *endings)()]


def read_system(path: Path) -> None:
    from studies.study.state_space import read_system

    read_system(path)


def tables() -> list[bytes]:
    from campaigns.mutations import matlab_files, measurements

    endings = ".csv", ".h5", ".mat"
    return [x for make in (measurements, matlab_files) for x in named(make, *endings)()]


def read_table(path: Path) -> None:
    from studies.errors import StudyError
    from studies.fitting.tables import column, read_columns

    columns = read_columns(path.name, path.parent, "file")
    for name in columns:
        with suppress(StudyError):
            column(columns, name, path.name, "column")


CONDITIONS = (
    "residual_rms[link=1] < 1e-6 and not gain_margin <= 2",
    "control.links[0] in [true, false] or link.modes == 3",
    "abs(gain_factor - 0.5) ** 2 <= max(1, min(2.0, pose_error_peak[2])) != 0",
    "controlled_modes not in (1, 2) and status == 0 and control.law == 'imsc'",
    "1 < substeps <= 3",
)
NAMES = (
    *("residual_rms[link=1]", "-gain_margin", "pose_error_peak[2]", "residual_mode_rms[mode=2]"),
    *("control.ratios[0][1]", "machine.kinds.rrr.crank_length", "sensor 1.1", "deflection 2 0.1"),
    *("status", "residual_peak[link=1][station=1]", "actuator 3.2", "drive.kp", "gain_factor"),
)


def with_sweep(use: Callable) -> Callable:
    """A reader of text that is about the results of a sweep."""

    def make(folder: Path) -> Callable[[bytes], object]:
        from campaigns.mutations import sweep_folder
        from studies.engine.results import read_sweep

        data = read_sweep(sweep_folder(folder)[0])
        return lambda content: use(data, content.decode(errors="replace"))

    return make


def condition(data: object, text: str) -> None:
    from studies.engine.results import meets

    meets(data, text, "--subject-to")


def name(data: object, text: str) -> None:
    """Everything that takes a name."""
    from studies.engine.results import metric_values
    from studies.errors import StudyError
    from studies.fitting.spec import own_signal
    from studies.study.entries import entry_sizes, parse_entries
    from studies.study.paths import checked_value, known_field
    from studies.sweeps.show import ranked_cases

    study = data.spec.study
    for use in (
        lambda: metric_values(data, text),
        lambda: ranked_cases(data, text),
        lambda: parse_entries(text, "x", entry_sizes(study)),
        lambda: known_field(text, study),
        lambda: checked_value(study, text, known_field(text, study), "x"),
        lambda: own_signal(study, text, "inputs"),
        lambda: own_signal(study, text, "outputs"),
    ):
        with suppress(StudyError):
            use()


def texts(*found: str) -> Callable[[], list[bytes]]:
    return lambda: [text.encode() for text in found]


TARGETS = {
    "study": Target(files, toml_target(parse_study)),
    "sweep": Target(lambda: files("sweep"), toml_target(parse_sweep)),
    "tuning": Target(lambda: files("tune"), toml_target(parse_tuning)),
    "fit": Target(lambda: files("fit"), toml_target(parse_fit)),
    "commission": Target(lambda: files("fit"), toml_target(parse_measured)),
    "controller": Target(controllers, controller_reader),
    "system": Target(systems, reader_of(read_system, ".json", ".npz", ".mat")),
    "table": Target(tables, reader_of(read_table, ".csv", ".h5", ".mat")),
    "condition": Target(texts(*CONDITIONS), with_sweep(condition)),
    "name": Target(texts(*NAMES), with_sweep(name)),
}


# --- running --------------------------------------------------------------------------------------


def keep_fault(error: BaseException, content: bytes, folder: Path) -> None:
    """Keep an input, unless one is kept that failed at the same place."""
    place = traceback.extract_tb(error.__traceback__)[-1]
    name = f"{type(error).__name__}-{Path(place.filename).stem}-{place.lineno}"
    if not (folder / name).exists():
        (folder / name).write_bytes(content)
        (folder / f"{name}.txt").write_text("".join(traceback.format_exception(error)))


def dictionary(folder: Path) -> Path:
    """Names of fields and other words, as libFuzzer reads them."""
    from studies.study.paths import all_fields

    names = {part for field in all_fields() for part in (field, field.rsplit(".", 1)[-1])}
    quoted = (json.dumps(word).replace("\\u001b", "\\x1b") for word in sorted({*names, *WORDS}))
    (folder / "words").write_text("\n".join(quoted) + "\n")
    return folder / "words"


def mutate(content: bytes, most: int, seed: int) -> bytes:
    """A change of bytes by libFuzzer, or of words."""
    import atheris

    if seed % 2:
        return atheris.Mutate(content, most)
    from campaigns.mutations import other_words

    text = other_words(content.decode(errors="replace"), np.random.default_rng(seed))
    return text.encode(errors="replace")[:most]


def fuzz(target: str, seconds: str, path: str) -> None:
    """Fuzz one target in this process, which libFuzzer ends."""
    folder = Path(path)
    import atheris

    import studies

    studies.configure()
    with atheris.instrument_imports(include=["studies"]):
        for module in MODULES:
            importlib.import_module(f"studies.{module}")
    from studies.errors import StudyError

    corpus, faults = folder / "corpus", folder / "faults"
    for part in (corpus, faults):
        part.mkdir(parents=True, exist_ok=True)
    for k, seed in enumerate(TARGETS[target].seeds()):
        (corpus / f"seed-{k}").write_bytes(seed)
    read = TARGETS[target].make(Path(mkdtemp()))

    def once(content: bytes) -> None:
        try:
            read(content)
        except StudyError as error:
            assert str(error), "an empty message"
        except Exception as error:
            keep_fault(error, content, faults)

    options = {"timeout": TIME, "rss_limit_mb": MEMORY, "max_len": SIZE, "len_control": 0}
    options |= {"max_total_time": round(float(seconds)), "artifact_prefix": f"{folder}/"}
    options |= {"dict": dictionary(folder), "print_final_stats": 1}
    given = [f"-{key}={value}" for key, value in options.items()]
    own = {} if target in BINARY else {"custom_mutator": mutate}
    atheris.Setup([target, *given, str(corpus)], once, **own)
    atheris.Fuzz()


#: What a process runs.
CODE = "import sys; from campaigns.fuzz import fuzz; fuzz(*sys.argv[1:])"


def fuzz_all(seconds: float, folder: Path, names: list[str]) -> int:
    """Fuzz targets one after the other, each in processes of its own; the exit code."""
    is_faulty = False
    for name in names:
        at, end = folder / name, time.monotonic() + seconds / len(names)
        at.mkdir(parents=True, exist_ok=True)
        with (at / "log").open("w") as log:
            while (left := end - time.monotonic()) > 1:  # a crash ends a process early
                command = [sys.executable, "-c", CODE, name, str(left), str(at)]
                with suppress(subprocess.TimeoutExpired):  # that is one longer than its own limit
                    subprocess.run(command, stdout=log, stderr=log, check=False, timeout=left + 60)
        found = [x.name for x in at.glob("faults/*") if x.suffix != ".txt"]
        found += [x.name for kind in ("crash", "timeout", "oom") for x in at.glob(f"{kind}-*")]
        is_faulty |= bool(found)
        said = (at / "log").read_text(errors="replace")
        count = sum(map(int, re.findall(r"number_of_executed_units: *(\d+)", said)))
        print(f"{name}: {count} inputs; {', '.join(found) or 'no fault'}", flush=True)
    return int(is_faulty)


if __name__ == "__main__":
    if len(sys.argv) < 3:
        sys.exit(__doc__)
    seconds, folder, *names = sys.argv[1:]
    sys.exit(fuzz_all(float(seconds), Path(folder), names or list(TARGETS)))
