"""Files as an adversary would change them: every kind that commands read, its originals, and how it
is read; changes of bytes, words, values and whole files, each from a seed."""

import json
import os
import re
import shutil
import signal
import string
from collections.abc import Callable
from contextlib import contextmanager
from io import StringIO
from pathlib import Path
from typing import NamedTuple
from unittest.mock import patch

import h5py
import numpy as np
from rich.console import Console
from scipy.io import loadmat, savemat

from jaxmodel.metrics import METRICS
from studies import passport
from studies.cache import VARIABLE
from studies.cluster.connect import written_address
from studies.commission.spec import load_measured
from studies.engine.columns import PER_CASE, label_of
from studies.engine.controller import fixed_controller
from studies.engine.design import load_design
from studies.engine.folder import (
    BASELINE,
    CONTENT,
    FIT,
    MANIFEST,
    RESULTS,
    SweepFolder,
    file_hash,
    make_manifest,
)
from studies.engine.folder import finished_cases as finished
from studies.engine.results import DIGEST, baseline_digest, baseline_id, read_sweep
from studies.engine.stored import manifest_attributes, merge
from studies.errors import StudyError
from studies.explorer.page import explorer_page
from studies.export.document import (
    FORMAT,
    Document,
    Masks,
    Quantity,
    document,
    import_study,
    read_document,
    study_hash,
    to_json,
)
from studies.fitting.explore import explore_fit
from studies.fitting.kinds.entry import FileEntry
from studies.fitting.spec import load_fit
from studies.fitting.tables import column, read_columns
from studies.job import locked_folder, working
from studies.kernels import compilation
from studies.kernels.compilation import ObjectCache, _key
from studies.passport import Passport
from studies.results.labelled import Variable
from studies.show.report import print_report
from studies.space.spec import load_sweep, parse_sweep
from studies.space.table import build_table
from studies.store import write_store
from studies.study.files import READY, read_toml
from studies.study.spec import Study, load_study
from studies.sweeps.run import case_content
from studies.sweeps.show import best_report, overview, ranked_cases
from studies.tuning import explore as tuning_explorer
from studies.tuning.folder import (
    CHECKED,
    PROGRESS,
    fixed_part,
    load_progress,
    refuse_edited,
    save_progress,
)
from studies.tuning.folder import RESULTS as TUNED
from studies.tuning.optimise import Progress, is_compatible, start_families
from studies.tuning.spec import load_tuning
from tests.fits import RESPONSE, blank
from tests.sweeps import small
from tests.tunings import EVERY_KIND, tuning

#: Time for a case [s].
LIMIT = 20.0
#: What stands for a value, in TOML and JSON.
WORDS = (
    *("0", "-1", "1e308", "-1e308", "1e-320", "1e999", "nan", "-inf", "NaN", "Infinity", "null"),
    *("9" * 20, "9" * 400, "9" * 5000, "true", '"x"', '""', "[]", "{}", "[[]]", "[[[[1]]]]"),
    *("[" * 500 + "]" * 500, "[" * 90_000, '"\\u001b[2J"', '"\\ud800"', '"../../etc/passwd"'),
    *('"' + "x" * 70_000 + '"', "1979-05-27", "0x1f", "+1", "1_0", "[1, [2, 3]]", '{"a" = 1}'),
)
#: Lines that are put in somewhere.
LINES = (
    ".".join("a" * 500) + " = 1",
    "[" + ".".join("a" * 500) + "]",
    "[tune]\n[fit]\n[sweep]",
    '[state_space]\nfile = "/dev/zero"\n[control]\nlaw = "state_space"',
    '[state_space]\nfile = "/dev/zero.json"\n[control]\nlaw = "state_space"',
    "\n".join(f"x{k} = {k}" for k in range(20_000)),
    "title = '\x7f'",
    "[[a]]\n[a]",
)
#: Values of a JSON file.
VALUES = (
    *(None, True, 0, -1, 1e308, 10**400, float("nan"), "", "x", "\x1b[2J", "\ud800", [], {}),
    *([[1.0]], [[[1.0]]], [None], {"a": {"b": 1}}, ["x"] * 3, [1, "x", []], "9" * 5000),
)


class Kind(NamedTuple):
    """Files of one kind."""

    make: Callable  # writes originals into a folder, returns their paths: files or folders
    read: Callable  # reads one of them, as commands do; of sealed ones, returns what it has read
    is_sealed: bool = False  # what is read must be as it was written: some of it, or a message


# --- originals ------------------------------------------------------------------------------------


def ready(section):
    """Makes copies of the ready-made files of one kind."""

    def make(folder):
        for path in READY.glob("*.toml"):
            kinds = [name for name in ("sweep", "tune", "fit") if name in read_toml(path)]
            if (kinds or ["study"]) == [section]:
                shutil.copy(path, folder)
        return sorted(folder.iterdir())

    return make


def matrices():
    """A controller, and the names of its inputs and outputs."""
    rng = np.random.default_rng(0)
    fields = {"A": 0.1 * rng.normal(size=(4, 4)), "B": rng.normal(size=(4, 2))}
    fields |= {"C": rng.normal(size=(2, 4)), "D": rng.normal(size=(2, 2)), "dt": 1e-4}
    ports = {"inputs": ["sensor 2.1", "sensor 1.3"], "outputs": ["actuator 3.2", "actuator 1.1"]}
    return fields, ports


def controllers(folder):
    fields, ports = matrices()
    as_lists = {name: np.asarray(x).tolist() for name, x in fields.items()}
    (folder / "x.json").write_text(json.dumps(as_lists | ports))
    np.savez(folder / "x.npz", **fields, **ports)
    np.savez_compressed(folder / "packed.npz", **fields, **ports)
    return sorted(folder.iterdir())


def matlab_files(folder):
    fields, ports = matrices()
    cells = {name: np.array(x, object) for name, x in ports.items()}
    for name, packed in (("x", False), ("packed", True)):
        savemat(folder / f"{name}.mat", fields | cells, do_compression=packed)
    return sorted(folder.iterdir())


def measurements(folder):
    rng = np.random.default_rng(0)
    columns = dict(zip(("time", "value", "other"), rng.normal(size=(3, 40)), strict=True))
    rows = "\n".join(",".join(map(str, row)) for row in zip(*columns.values(), strict=True))
    (folder / "x.csv").write_text(f"{','.join(columns)}\n{rows}\n")
    with h5py.File(folder / "x.h5", "w") as file:
        for name, data in columns.items():
            file.create_dataset(name, data=data, compression="gzip")
    return sorted(folder.iterdir())


def gains(folder):
    study = load_study(READY / "paper.toml")
    (folder / "flexlink.json").write_text(to_json(document(fixed_controller(study))))
    return [folder / "flexlink.json"]


def bare_gains(folder):
    """The same without the numbers of a controller, which would have to be compiled."""
    study = load_study(READY / "paper.toml")
    number = Quantity(value=[[1.0, 2.0], [3.0, 4.0]], unit="1", axes=["link", "mode"], meaning="x")
    whole = Document(
        format=FORMAT,
        format_version=1,
        title="x",
        case_id="",
        study_hash=study_hash(study),
        versions={"python": "3"},
        law=study.control.law,
        estimator=study.electronics.estimator,
        order="x",
        steps=["x"],
        masks=Masks(links=[True] * 3, modes=[[True]] * 3),
        numbers={"gain": number, "other": number},
        study=json.loads(json.dumps(study.model_dump(mode="json"))),
    )
    (folder / "flexlink.json").write_text(to_json(whole))
    return [folder / "flexlink.json"]


def sweep_folder(folder):
    """A finished sweep with made-up numbers, and an unfinished one."""
    data = small({"axes": {"gain": [0.1, 0.5, 1.0], "controlled_modes": [1, 2]}})
    table, rng = build_table(parse_sweep(data)), np.random.default_rng(0)
    manifest = make_manifest(data) | {CONTENT: case_content(parse_sweep(data))}
    for name, count in (("whole", 6), ("part", 4)):
        chunk = {"case_id": table.case_id[:count]}
        for metric in (*PER_CASE, *METRICS):
            shape = (count, *(3 for _ in label_of(metric)[0]))
            codes = metric in ("status", "substeps")
            chunk[metric] = np.zeros(shape, int) if codes else rng.uniform(1, 2, shape)
        with locked_folder(folder / name, "sweep"):
            out = SweepFolder(folder / name)
            out.begin(manifest)
            out.write_chunk(chunk)
            if count == len(table):
                attributes = {"title": "small", **manifest_attributes(manifest)}
                merge(out.path, table, finished(out.path), attributes)
                out.publish()
                spec = parse_sweep(data)
                step = Variable(np.full(3, 1e-7), ("link",), "m", "one ADC step")
                baseline = {"status": Variable(np.array(0), (), "1", "status"), "adc_step": step}
                for metric in METRICS:
                    dims, *label = label_of(metric)
                    values = rng.uniform(1, 2, tuple(3 for _ in dims))
                    baseline[metric] = Variable(values, dims, *label)
                seal = {"case_id": baseline_id(spec), DIGEST: baseline_digest(baseline)}
                write_store(out.path / BASELINE, baseline, seal)
    return [folder / "whole", folder / "part"]


def opened_tuning(out, spec, resume):
    """The folder of a tuning, as `studies.tune` opens it."""
    request = {"spec": spec.data, "code": ""}
    return working("tune", out, request, (), resume, False, CHECKED, fixed_part)


def tuning_folder(folder):
    spec = tuning(EVERY_KIND, starts=2, iterations=3)
    out, p = folder / "tuned", len(spec.free.names)
    starts, m = len(start_families(spec)), len(spec.limit_names)
    shapes = {"base_slope": (starts, p), "base_limits": (starts, m), "history": (3, starts, 2)}
    at = {name: np.zeros(shapes.get(name, (starts,))) for name in Progress._fields}
    with opened_tuning(out, spec, False):
        save_progress(out / PROGRESS, Progress(**at | {"descent": (np.zeros(3),)}))
    shutil.copy(READY / "paper.toml", out / "tuned.toml")
    return [out]


def tuned_folder(folder):
    """A finished tuning with made-up numbers, of which nothing is to be replayed."""
    spec = tuning(EVERY_KIND, starts=2, iterations=3)
    (folder / "tuned").mkdir()
    rng, k, p = np.random.default_rng(0), 2, len(spec.free.names)
    numbers = {"objective": (k,), "linear_residual": (k,), "is_frozen": (k,), "value": (k, p)}
    numbers |= {"patch_center": (k, 3, 3)}
    axes = ("start", "free", "mode")
    data = {
        name: Variable(1 + rng.random(shape), axes[: len(shape)], "1", name)
        for name, shape in numbers.items()
    }
    data["patch_center"] = data["patch_center"]._replace(dims=("start", "link", "patch"))
    data["is_frozen"] = Variable(np.ones(k, np.int8), ("start",), "1", "is_frozen")
    texts = {"start_family": [spec.families[0].name] * k, "free": spec.free.names}
    texts["free_unit"] = ["1"] * p
    for name, text in texts.items():
        axis = ("start",) if name == "start_family" else ("free",)
        data[name] = Variable(np.array(text), axis, "1", name)
    write_store(folder / "tuned" / TUNED, data, {"tuning": json.dumps(spec.data)})
    return [folder / "tuned"]


def fit_folder(folder):
    """A finished fit with made-up numbers."""
    (folder / "fitted").mkdir()
    rng, names = np.random.default_rng(0), ["link.damping_ratio", "drive.kp"]
    sizes = {"optimum": ("start", 2), "machine": ("sample", 5), "value": (), "sigma": ()}
    data = {
        name: Variable(rng.random((*of[1:], 2)), (*of[:1], "number"), "1", name)
        for name, of in sizes.items()
    }
    data["optimum_rise"] = Variable(np.zeros(2), ("start",), "1", "rise")
    data["correlation"] = Variable(np.eye(2), ("number", "other"), "1", "correlation")
    data["number"] = Variable(np.array(names), ("number",), "1", "number")
    study = load_study(READY / "paper.toml").model_dump_json()
    write_store(folder / "fitted" / FIT, data, {"study": study})
    return [folder / "fitted"]


def measured_file(folder):
    """A commissioning, and its measurements."""
    blank(folder)
    entry = "\n".join(f"{key} = {json.dumps(value)}" for key, value in RESPONSE.items())
    (folder / "measured.toml").write_text(
        '[control]\nmodes = 1\n[commission]\ntarget = "c"\ngain_margin = 2.0\n[tune]\nstarts = 2\n'
        '[fit]\nstarts = 2\n[fit.free]\n"load.mass" = { from = 0.0, to = 1.0 }\n'
        f"[[fit.data]]\n{entry}\n"
    )
    return [folder / "measured.toml"]


def kept_program(folder):
    """A program in the cache."""
    with cached_in(folder):
        ObjectCache("program", "x").keep(bytes(range(256)))
    return sorted(folder.glob("program-*"))


def kept_outcome(folder):
    """An outcome of `studies verify`."""
    with cached_in(folder):
        found = Passport("x", 11, 13, ("one", "two"), "2026-01-01", "1.0", "processor")
        passport.keep(Study(), found)
    return sorted(folder.glob("passport-*"))


def scheduler_file(folder):
    (folder / "cluster.json").write_text('{"address": "tcp://127.0.0.1:8786", "type": "Scheduler"}')
    return [folder / "cluster.json"]


# --- readers --------------------------------------------------------------------------------------


def read_controller(path):
    study = path.with_name("study.toml")
    study.write_text(
        f'[control]\nlaw = "state_space"\n[state_space]\nfile = {json.dumps(path.name)}\n'
    )
    load_study(study)


def read_measurement(path):
    found = read_columns(path.name, path.parent, "file")
    for name in found:
        column(found, name, path.name, "column")


def read_fit(path):
    spec = load_fit(path)
    for entry in spec.entries:
        if isinstance(entry, FileEntry):
            read_columns(entry.file, spec.folder, "file")


def read_sweep_file(path):
    spec = load_sweep(path)
    if spec.sweep.count < 10_000 and spec.sweep.repeats < 100:
        build_table(spec)


def read_sweep_folder(path):
    data, console = read_sweep(path), Console(file=StringIO())
    print_report(overview(data), console)
    cases = ranked_cases(data, "residual_rms", "gain_margin > 0", 10)
    print_report(best_report(data, "residual_rms", "", cases, "", []), console)
    load_design(path, "0")


def read_tuning_folder(path):
    load_design(path, None)
    spec = tuning(EVERY_KIND, starts=2, iterations=3)
    with opened_tuning(path, spec, True):
        if (at := load_progress(path / PROGRESS)) is not None:
            is_compatible(spec, at)
            refuse_edited(path)


def read_sealed_sweep(path):
    """Metrics of each finished case, and the baseline's."""
    data = read_sweep(path)
    rows = np.array(data.table.case_id)
    found = {
        (name, case): np.asarray(data[name])[k].tobytes()
        for name in METRICS
        if name in data.variables
        for k, case in enumerate(rows)
        if data["status"][k] >= 0
    }
    return found | {
        (name, "baseline"): np.asarray(x.data).tobytes()
        for name, x in data.baseline.items()
        if name in METRICS
    }


def read_tuned_folder(path):
    with patch.object(tuning_explorer, "MOST_REPLAYS", 0):
        explorer_page(tuning_explorer.explore_tuning(path, lambda *_: None))


def read_fit_folder(path):
    explorer_page(explore_fit(path, lambda *_: None))


@contextmanager
def cached_in(folder):
    """The cache in a folder, for what is read and written here."""
    _key.cache_clear()
    with (
        patch.dict(os.environ, {VARIABLE: str(folder)}),
        patch.object(compilation, "cache_folder", lambda: str(folder)),
    ):
        yield
    _key.cache_clear()


def read_program(path):
    key = path.with_name("key")
    if not key.exists():  # of the originals, beside which this is a copy
        shutil.copy(path.parents[1] / "originals" / "key", key)
    with cached_in(path.parent):
        code = ObjectCache("program", "x").take()
    return {} if code is None else {"code": code}


def read_outcome(path):
    with cached_in(path.parent):
        found = passport.find(Study())
    return {} if found is None else {"outcome": found}


KINDS = {
    "study": Kind(ready("study"), load_study),
    "sweep": Kind(ready("sweep"), read_sweep_file),
    "tuning": Kind(ready("tune"), load_tuning),
    "fit": Kind(ready("fit"), read_fit),
    "controller": Kind(controllers, read_controller),
    "MATLAB file": Kind(matlab_files, read_controller),
    "measurement": Kind(measurements, read_measurement),
    "sweep folder": Kind(sweep_folder, read_sweep_folder),
    "tuning folder": Kind(tuning_folder, read_tuning_folder),
    "gains": Kind(gains, import_study),
    "document": Kind(bare_gains, read_document),
    "commissioning": Kind(measured_file, load_measured),
    "tuned folder": Kind(tuned_folder, read_tuned_folder),
    "fit folder": Kind(fit_folder, read_fit_folder),
    "scheduler": Kind(scheduler_file, lambda path: written_address(str(path))),
    "chunks": Kind(sweep_folder, read_sealed_sweep, True),
    "program": Kind(kept_program, read_program, True),
    "outcome": Kind(kept_outcome, read_outcome, True),
}


# --- changes --------------------------------------------------------------------------------------


def change(path, rng):
    """Change a file, or one file of a folder."""
    if path.is_dir():
        files = sorted(x for x in path.rglob("*") if x.is_file())
        change_results(path, rng) if rng.random() < 0.3 else change(rng.choice(files), rng)
        return
    special = {".json": change_json, ".npz": change_npz, ".mat": change_mat, ".h5": change_hdf5}
    text = {".json", ".toml", ".csv"}
    ways = [special.get(path.suffix), change_words if path.suffix in text else None, change_bytes]
    way = rng.choice([way for way in ways if way] * 3 + [replace])
    for _ in range(rng.choice([1, 1, 2, 4])):
        if path.is_file() and path.stat().st_size:
            way(path, rng)


def change_bytes(path, rng):
    content = bytearray(path.read_bytes())
    at, size = int(rng.integers(len(content))), int(2 ** rng.integers(0, 8))
    kind = rng.integers(6)
    if kind == 0:
        content[at] = rng.integers(256)
    elif kind == 1:
        content[at : at + size] = rng.bytes(size)
    elif kind == 2:
        del content[at : at + size]
    elif kind == 3:
        del content[at:]
    elif kind == 4:
        content[at:at] = content[at // 2 : at // 2 + size]
    else:
        content[at : at + 4] = rng.choice([b"\xff\xff\xff\xff", b"\x0e\0\0\0", b"\0\0\0\x80"])
    path.write_bytes(content)


def change_words(path, rng):
    """Another value for a number, text or name; a strange line."""
    text = path.read_bytes().decode(errors="replace")
    path.write_bytes(other_words(text, rng).encode(errors="replace"))


def other_words(text, rng):
    """The same of a text."""
    words = list(re.finditer(r"-?\d[\w.+-]*|\"[^\"\n]*\"|[A-Za-z_]\w*|[\[\]{},:=]", text))
    if not words or rng.random() < 0.15:
        lines = text.splitlines()
        lines.insert(int(rng.integers(len(lines) + 1)), str(rng.choice(LINES)))
        return "\n".join(lines)
    word = words[rng.integers(len(words))]
    other = words[rng.integers(len(words))][0]
    return text[: word.start()] + str(rng.choice([*WORDS, other, other])) + text[word.end() :]


def change_json(path, rng):
    """Another value, or none, somewhere in the tree."""
    try:
        at = whole = json.loads(path.read_bytes())
    except (ValueError, RecursionError):
        return
    parent, key = None, None
    while isinstance(at, (dict, list)) and at and (parent is None or rng.random() < 0.8):
        parent, key = at, rng.choice(list(at)) if isinstance(at, dict) else rng.integers(len(at))
        key = str(key) if isinstance(at, dict) else int(key)
        at = parent[key]
    value = VALUES[rng.integers(len(VALUES))]
    if parent is None:
        whole = value
    elif rng.random() < 0.2:
        del parent[key]
    elif isinstance(parent, dict) and rng.random() < 0.1:
        parent.update({f"{name}{k}": k for k in range(20_000) for name in "xyz"})
    else:
        parent[key] = value
    path.write_text(json.dumps(whole))


def strange(array, rng):
    """An array of another type or shape."""
    array = np.asarray(array)
    text = np.array(["x", "sensor 1.1\x1b"])
    others = [array[None], array.ravel(), np.zeros(0), np.zeros((0, 0)), np.float64(1.0), text]
    if array.dtype.kind in "iuf":
        others += [array * (1 + 1e-6j), array * 0 + 1e308, array * np.nan, array.astype(bool)]
        others += [array.astype(">f4"), array.astype(np.int8), array.T]
    others.append(np.zeros(3, [("a", float), ("b", "S3")]))
    return others[rng.integers(len(others))]


def change_npz(path, rng):
    try:
        with np.load(path) as file:
            arrays = dict(file)
    except Exception:
        return
    name = str(rng.choice(sorted(arrays)))
    arrays[name] = strange(arrays[name], rng)
    if rng.random() < 0.2:
        del arrays[name]
    elif rng.random() < 0.1:
        arrays[name] = np.array([{}, None], object)
    elif rng.random() < 0.02:
        arrays[name] = np.zeros(2**23)
    np.savez_compressed(path, **arrays)


def change_mat(path, rng):
    try:
        found = loadmat(path) if path.read_bytes()[:6] == b"MATLAB" else {}
        arrays = {name: x for name, x in found.items() if not name.startswith("__")}
    except Exception:
        return
    if not arrays:
        return
    name = str(rng.choice(sorted(arrays)))
    arrays[name] = strange(arrays[name], rng)
    savemat(path, {name: x for name, x in arrays.items() if rng.random() < 0.9})


def change_hdf5(path, rng):
    """Another type, shape, label or place of a dataset, inside the file or elsewhere."""
    try:
        with h5py.File(path, "r+") as file:
            name = str(rng.choice(sorted(file)))
            labels = dict(file[name].attrs)
            kind = rng.integers(8)
            data = file[name][()] if isinstance(file[name], h5py.Dataset) else np.zeros(2)
            if kind == 0 and labels:
                del file[name].attrs[str(rng.choice(sorted(labels)))]
                return
            if kind == 1 and file.attrs:
                file.attrs[str(rng.choice(sorted(file.attrs)))] = rng.choice(["{", "", "[]"])
                return
            del file[name]
            if kind == 2:
                file.create_group(name)
            elif kind == 3:
                file[name] = h5py.ExternalLink(str(path.with_name("other.h5")), "/x")
            elif kind == 4:
                file[name] = h5py.SoftLink("/nothing")
            elif kind == 5:
                file.create_dataset(name, (2**36,), "f8", chunks=(2**20,))
            elif kind in (6, 7):
                file[name] = strange(data if data.dtype.kind in "iuf" else np.zeros(3), rng)
                if rng.random() < 0.8:
                    file[name].attrs.update({"units": "1", "long_name": "x"})
    except Exception:
        return


def change_results(path, rng):
    """Results that the manifest vouches for."""
    if not (path / RESULTS).is_file():
        return
    for _ in range(rng.integers(1, 3)):
        rng.choice([change_hdf5, change_hdf5, change_bytes])(path / RESULTS, rng)
    if (path / BASELINE).is_file() and rng.random() < 0.5:
        rng.choice([change_hdf5, change_hdf5, change_bytes])(path / BASELINE, rng)
    manifest = json.loads((path / MANIFEST).read_text())
    (path / MANIFEST).write_text(json.dumps(manifest | {"results": [file_hash(path / RESULTS)]}))


def replace(path, rng):
    """Something else under the file's name."""
    path.unlink()
    kind = rng.integers(6)
    if kind == 0:
        os.mkfifo(path)
    elif kind == 1:
        path.symlink_to("/dev/zero")
    elif kind == 2:
        path.mkdir()
    elif kind == 3:
        path.symlink_to(path)
    elif kind == 4:
        path.write_bytes(rng.bytes(300))
    else:
        with path.open("wb") as file:
            file.truncate(2**40)  # takes no room


# --- attacks --------------------------------------------------------------------------------------


class Hang(BaseException):
    """A case took longer than `LIMIT`; no reader catches this."""


@contextmanager
def time_limit(seconds):
    def stop(*_):
        raise Hang(f"more than {seconds} s")

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def originals(kind, folder):
    """Original files of a kind."""
    folder.mkdir()
    return KINDS[kind].make(folder)


def attack(kind, found, folder, seed):
    """Change one original and read it; says what went wrong, "" for a message or success."""
    rng = np.random.default_rng([seed, len(kind), *map(ord, kind)])
    original = found[rng.integers(len(found))]
    work = folder / f"{''.join(x for x in kind if x in string.ascii_letters)}-{seed}"
    work.mkdir()
    path = work / original.name
    shutil.copytree(original, path) if original.is_dir() else shutil.copy(original, path)
    for beside in original.parent.glob("*.csv") if kind in ("fit", "commissioning") else ():
        shutil.copy(beside, work)
    _, read, is_sealed = KINDS[kind]
    change(rng.choice(sorted(path.rglob("*.h5"))) if is_sealed and path.is_dir() else path, rng)
    try:
        with time_limit(LIMIT):
            answer = read(Path(path))
            if is_sealed:
                assert answer.items() <= read(original).items(), "another answer than was written"
    except StudyError as error:
        fault = "" if str(error) else "an empty message"
    except (Exception, Hang) as error:
        fault = f"{type(error).__name__}: {error}"
    else:
        fault = ""
    if not fault:
        shutil.rmtree(work)
        return ""
    return f"{kind}, seed {seed} ({work}): {fault[:300]}"
