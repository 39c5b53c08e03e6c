"""Commands killed at random moments and run again, as users do: nothing is lost, doubled or left.

Half of the kills come by the clock, at a moment drawn over the whole command; the others just
before a change of a file drawn from all that it makes: by the clock, what is short is hit rarely.
"""

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import h5py
import numpy as np
import psutil
from matplotlib.image import imread, imsave

import studies
from studies.commission.stages import STAGES
from studies.study.template import toml_text
from tests.clusters import Machines
from tests.fits import SHORT
from tests.sweeps import MIXED, small
from tests.tunings import GAIN, SMALL

#: The command line with chunks of 16 cases as in the other tests, which ends before a change of a
#: file or counts the changes.
SCRIPT = """
import atexit, os, signal, sys
import studies
studies.configure()
from studies.cli import main
from studies.engine import plan

plan.LANES, plan.LARGEST_CHUNK = 8, 16
if "many.toml" in sys.argv[2]:
    from studies.screen import shards
    shards.SHARD, shards.LANES = (64, 64), 8
if sys.argv[1] == "compare":
    from jaxmodel.laws import LAWS
    from studies.laws import candidates, run
    from studies.laws.tuning import Budget
    drives = run.drive_candidates
    run.law_candidates = lambda study: [candidates.law_candidate(study, LAWS["srf"])]
    run.drive_candidates = lambda study: [x for x in drives(study) if x.name == "PD"]
    run.make_budget = lambda *_: Budget(50.0, 0.4, starts=2, iterations=2)
    run.MACHINES = 2
place, step = os.environ["KILL_PLACE"], int(os.environ["KILL_STEP"])
changes, count = {"os.rename", "os.remove", "os.rmdir", "os.mkdir"}, [0]

def is_change(event, given):
    if event == "open":
        return isinstance(given[2], int) and given[2] & (os.O_WRONLY | os.O_RDWR)
    return event in changes

def watch(event, given):
    if is_change(event, given) and str(given[0]).startswith(place):
        count[0] += 1
        if count[0] == step:
            os.killpg(0, signal.SIGKILL) if "KILL_GROUP" in os.environ else os.kill(os.getpid(), 9)

def tell():
    os.write(told, str(count[0]).encode())

told = os.open(os.environ["KILL_COUNT"], os.O_WRONLY | os.O_CREAT)
sys.addaudithook(watch)
atexit.register(tell)
main()
"""
#: Longest that a command may take, and that what it has started may outlive it [s].
LIMIT, GRACE = 900, 10
#: Names of what only serves to go on, and of what a file says of one call.
WORKING = {
    "sweep.json",
    "screen.json",
    "screen.h5",
    "tune.json",
    "request.json",
    "progress.npz",
    "parts",
    "chunks",
    "cache",
}
#: And files of which only that they are whole is compared: they hold times.
TIMED = {"parts"}
OF_ONE_CALL = {"results", "git", "run_time", "compile_time"}


class Command(NamedTuple):
    """A command line, run in a folder of its own."""

    kind: str
    words: tuple[str, ...]
    before: Path | None = None  # what is in the folder at first
    is_cold: bool = False  # with an empty cache of compiled programs


class Whole(NamedTuple):
    """What the command leaves if it is not killed."""

    contents: dict
    names: set
    earlier: dict  # contents of what was there before
    place: Path
    duration: float  # [s]
    steps: int  # changes of files


@dataclass
class Tally:
    """Of one kind of command."""

    kills: int = 0
    equal: int = 0  # kills after which the result is that of the uninterrupted command
    leftovers: int = 0
    orphans: int = 0
    faults: list = field(default_factory=list)


# --- results --------------------------------------------------------------------------------------


def names_in(folder):
    """Names of all files and folders."""
    return {str(path.relative_to(folder)) for path in folder.rglob("*")}


def contents(folder):
    """What all files say that are no hidden ones, by name."""
    files = {str(path.relative_to(folder)): path for path in sorted(folder.rglob("*"))}
    return {
        name: read(path)
        for name, path in files.items()
        if path.is_file() and not any(part.startswith(".") for part in Path(name).parts)
    }


def read(path):
    """A file's numbers and words; raises an exception if it is not whole."""
    if path.suffix == ".h5":
        with h5py.File(path) as file:
            return {name: stored[()] for name, stored in file.items()}
    if path.suffix == ".npz":
        with np.load(path) as file:
            return dict(file)
    if path.suffix == ".npy":
        return np.load(path)
    if path.suffix == ".png":
        return imread(path)
    if path.suffix == ".json":
        return json.loads(path.read_text("utf-8"))
    return path.read_bytes()


def same(a, b, tolerance=1e-12):
    """Whether two contents agree to a relative tolerance."""
    if isinstance(a, dict) and isinstance(b, dict):
        keys = a.keys() - OF_ONE_CALL
        return keys == b.keys() - OF_ONE_CALL and all(same(a[k], b[k]) for k in keys)
    if isinstance(a, list) and isinstance(b, list):
        return len(a) == len(b) and all(map(same, a, b))
    x, y = np.asarray(a), np.asarray(b)
    if x.dtype.kind not in "fc" or x.shape != y.shape:
        return bool(np.array_equal(x, y))
    is_finite = np.isfinite(x)
    if not np.array_equal(x[~is_finite], y[~is_finite], equal_nan=True):
        return False
    size = np.abs(x[is_finite]).max(initial=0.0)
    return bool(np.all(np.abs(x[is_finite] - y[is_finite]) <= tolerance * size))


def differences(found, wanted):
    """Names of files that are missing, too many or different."""
    return sorted(
        name
        for name in found.keys() | wanted.keys()
        if name not in found or name not in wanted or not same(found[name], wanted[name])
    )


def last_file(names):
    """The file that says that all are there: the document, or else the page."""
    for suffix in (".json", ".html", ""):
        found = [name for name in names if name.endswith(suffix)]
        if found:
            return max(found, key=lambda name: (-name.count("/"), name))
    return ""


def kept(contents):
    """Those of files that users read."""
    return {name: x for name, x in contents.items() if not WORKING & set(Path(name).parts)}


# --- commands -------------------------------------------------------------------------------------


class Campaign:
    """Kills commands and counts what becomes of them."""

    def __init__(self, folder, seed):
        self.folder, self.rng = Path(folder), random.Random(seed)
        self.tallies, self._count, self._wholes = {}, 0, {}

    def new_folder(self):
        """A name for one more folder."""
        self._count += 1
        return self.folder / f"trial{self._count}" / "place"

    def fresh(self, command):
        """A folder in which a command begins."""
        place = self.new_folder()
        if command.before:
            shutil.copytree(command.before, place)
        else:
            place.mkdir(parents=True)
        return place

    def begin(self, command, place, step=0, is_group=False):
        """Start a command; step: the change of a file before which it dies, 0: none."""
        scratch = Path(f"{place.parent}.tmp")
        scratch.mkdir(exist_ok=True)
        environment = os.environ | {
            "PYTHONPATH": str(Path(studies.__file__).parents[1]),
            "TMPDIR": str(scratch),
            "KILL_PLACE": f"{place.parent}/",
            "KILL_STEP": str(step),
            "KILL_COUNT": f"{place.parent}.count",
        }
        if is_group:
            environment["KILL_GROUP"] = "yes"
        if command.is_cold:
            (place.parent / "cache").mkdir(mode=0o700, exist_ok=True)
            environment["JAX_COMPILATION_CACHE_DIR"] = str(place.parent / "cache")
        with open(f"{place.parent}.log", "a") as log:
            return subprocess.Popen(
                [sys.executable, "-c", SCRIPT, *command.words],
                cwd=place,
                env=environment,
                stdout=log,
                stderr=log,
                start_new_session=True,
            )

    def whole(self, command):
        """The command's results without a kill, made once."""
        if command not in self._wholes:
            place = self.fresh(command)
            earlier = contents(place)
            start = time.monotonic()
            code = self.begin(command, place).wait(timeout=LIMIT)
            took = time.monotonic() - start
            assert code == 0, f"{command.kind}: {said(place)}"
            steps = int(Path(f"{place.parent}.count").read_text())
            whole = Whole(contents(place), names_in(place), earlier, place, took, steps)
            self._wholes[command] = whole
        return self._wholes[command]

    def tally(self, kind):
        return self.tallies.setdefault(kind, Tally())

    def kill(self, command, place, whole, is_due=True):
        """Run a command and kill it if due; whether it was killed before its end."""
        is_group = self.rng.random() < 0.5
        if not is_due:
            process = self.begin(command, place)
        elif whole.steps and self.rng.random() < 0.5:
            process = self.begin(command, place, self.rng.randint(1, whole.steps), is_group)
        else:
            process = self.begin(command, place)
            with suppress(subprocess.TimeoutExpired):
                process.wait(timeout=self.rng.random() * whole.duration)
            if process.poll() is None:
                (os.killpg if is_group else os.kill)(process.pid, signal.SIGKILL)
        code, tally = process.wait(timeout=LIMIT), self.tally(command.kind)
        if left := outlived(place):
            tally.orphans += len(left)
            tally.faults.append(f"{place}: still running: {left}")
        if code not in (0, -signal.SIGKILL):
            tally.faults.append(f"{place}: exit code {code}: {said(place)[-300:]}")
        return code == -signal.SIGKILL

    def trial(self, command, most):
        """Kill a command up to so often, then let it end; how many kills that were."""
        whole, place, kills = self.whole(command), self.fresh(command), 0
        tally, start = self.tally(command.kind), time.monotonic()
        while self.kill(command, place, whole, kills < most):
            kills += 1
            tally.faults += [f"{place}, kill {kills}: {x}" for x in half_done(place, whole)]
        if not kills:  # programs are compiled only once
            took = min(whole.duration, time.monotonic() - start)
            self._wholes[command] = whole._replace(duration=took)
        self.judge(command.kind, place, whole, kills)
        return kills

    def judge(self, kind, place, whole, kills):
        """Compare what a command has left at its end with what it leaves without kills."""
        tally = self.tally(kind)
        different = [
            name
            for name in differences(contents(place), whole.contents)
            if not TIMED & set(Path(name).parts)
        ]
        left = sorted(names_in(place) - whole.names)
        tally.kills += kills
        tally.equal += 0 if different else kills
        tally.leftovers += len(left)
        words = ["Traceback"] if "Traceback" in said(place) else []
        tally.faults += [f"{place}: {x}" for x in (different, left, words) if x]

    def kills(self, command, count, most=3):
        """At least so many kills of a command, a few in each trial."""
        done = 0
        while done < count:
            done += self.trial(command, min(most, count - done))


def said(place):
    """All that a command printed in a folder."""
    return Path(f"{place.parent}.log").read_text(errors="replace")


def half_done(place, whole):
    """Faults of a folder in which a command was killed: it holds a result, an earlier one, or none.

    Each file is whole; with the one that is written last, all are of one result.
    """
    try:
        found = kept(contents(place))
    except (OSError, ValueError, RuntimeError) as error:
        return [f"not whole: {error}"]
    versions = kept(whole.contents), kept(whole.earlier)
    faults = [
        f"neither old nor new: {name}"
        for name, x in found.items()
        if not any(name in version and same(x, version[name]) for version in versions)
        and not (name.endswith(".toml") and last_file(versions[0]) not in found)  # best so far
    ]
    last = last_file(versions[0])
    if last in found and all(differences(found, version) for version in versions):
        faults.append(f"{last} is there, but {differences(found, versions[0])} are not of it")
    return faults


def outlived(place):
    """Processes of a killed command that do not end by themselves, and are ended here."""
    mark, deadline = f"{place.parent}/", time.monotonic() + GRACE
    while found := [x for x in psutil.process_iter() if mark == place_of(x)]:
        if time.monotonic() > deadline:
            lines = [" ".join(process.cmdline())[:200] for process in found]
            for process in found:
                process.kill()
            return lines
        time.sleep(0.1)
    return []


def place_of(process):
    """Where the command was run that has started a process, "" for others."""
    try:
        is_dead = process.status() == psutil.STATUS_ZOMBIE
        return "" if is_dead else process.environ().get("KILL_PLACE", "")
    except (psutil.Error, OSError):
        return ""


def aged(folder, place):
    """A copy of results of which every file says something else, as an earlier one would."""
    shutil.copytree(folder, place)
    for path in place.rglob("*.*"):
        if path.suffix == ".h5":
            with h5py.File(path, "r+") as file:
                name = next(name for name, x in file.items() if x.dtype.kind == "f" and x.size)
                file[name][...] = 2 * file[name][()] + 1
        elif path.suffix == ".png":
            imsave(path, np.zeros((2, 2)))
        elif path.suffix == ".npz":
            np.savez(path, earlier=1.0)
        elif path.suffix == ".json":
            path.write_text(json.dumps(json.loads(path.read_text("utf-8")) | {"earlier": 1}))
        elif path.is_file():
            path.write_text(path.read_text("utf-8") + "\n")
    return place


# --- all kinds of commands ------------------------------------------------------------------------

ON = ("--out", "out", "--resume")
#: Commands by kind, in a folder two below that of their files; those with --resume go on.
COMMANDS = {
    "sweep": ("sweep", "../../sweep.toml", *ON),
    "sweep, empty cache": ("sweep", "../../sweep.toml", *ON),
    "sweep, local workers": ("sweep", "../../longer.toml", *ON, "--workers", "2"),
    "extension": ("sweep", "../../longer.toml", *ON),
    "sweep that keeps": ("sweep", "../../many.toml", *ON),
    "tune": ("tune", "../../tune.toml", *ON),
    "atlas": ("atlas", "../../study.toml", *ON),
    "plot": ("plot", "out"),
    "explore": ("explore", "out"),
    "simulate": ("simulate", "../../study.toml", "--out", "run.h5", "--report"),
    "plant": ("plant", "../../study.toml", "--out", "plant.npz"),
    "export": ("export", "../../study.toml", "--target", "c", "--out", "out"),
    "fit": ("fit", "../../fit.toml", *ON),
    "certify": ("certify", "../../study.toml", *ON),
    "compare": ("compare", "../../study.toml", *ON),
    "paper": ("paper", "zhang_2016", *ON),
    "twin": ("twin", "../../study.toml", *ON),
    "verify": ("verify", "../../study.toml", *ON),
}
#: Designs to choose from.
RANDOM = {"method": "random", "axes": {"gain": {"from": 0.1, "to": 1.0}, "placement": {}}}
#: Those that begin in the folder of a finished sweep.
AFTER_SWEEP = ("extension", "plot", "explore")
COMMISSION = Command("commission", ("commission", "../../commission.toml", *ON))


def write_files(folder):
    """Files that the commands read."""
    more = {**MIXED, "blocks": [MIXED["blocks"][0] | {"count": 8}]}
    short = {name: dict(section) for name, section in SHORT.items()}
    modes = {"kind": "modes", "frequency_hz": [114.0, 115.0, 118.0], "sigma_hz": 5.0}
    stiffness = {"link.youngs_modulus": {"from": 60e9, "to": 80e9}}
    fit = short | {"fit": {"free": stiffness, "data": [modes]}}
    quick = {"tune": {"starts": 1, "iterations": 2}, "commission": {"gain_margin": 1.5}}
    files = {
        "sweep": small(),
        "longer": small(more),
        "many": small({**RANDOM, "count": 1000, "keep": 20, "fidelity": "linear"}),
        "stiffer": small(more, drive={"kp": 4e4}),
        "tune": SMALL | {"tune": {"free": GAIN, "starts": 3, "iterations": 6}},
        "fit": fit,
        "commission": fit | quick | {"link": short["link"] | {"modes": 2}},
        "study": SMALL | {"control": SMALL["control"] | {"gain_factor": 0.4}},
    }
    for name, data in files.items():
        (folder / f"{name}.toml").write_text(toml_text(data))


def kill_command(campaign, kind, count):
    """Kill a command in an empty folder; one that begins anew also over an earlier result."""
    before = None
    if kind in AFTER_SWEEP:
        before = campaign.whole(Command("sweep", COMMANDS["sweep"])).place
    command = Command(kind, COMMANDS[kind], before, is_cold="empty" in kind)
    is_new = "--resume" not in command.words and not before and campaign.whole(command).names
    n_over = count // 2 if is_new else 0
    campaign.kills(command, count - n_over)
    if n_over:
        earlier = aged(campaign.whole(command).place, campaign.new_folder())
        campaign.kills(command._replace(before=earlier), n_over)


def kill_commission(campaign, count):
    """Kill a commissioning from its first stage on, from its second, and from the last two."""
    finished = campaign.whole(COMMISSION).place
    firsts = [*STAGES][:3]
    for k, first in enumerate(firsts):
        before = campaign.new_folder()
        shutil.copytree(finished, before)
        remove_from(before / "out", first)
        share = count // 3 + (k < count % 3)
        campaign.kills(COMMISSION._replace(before=before), share)


def remove_from(out, first):
    """Take a stage and those after it out of a commissioning's folder."""
    names = [*STAGES]
    for name in names[names.index(first) :]:
        shutil.rmtree(out / name)
    for name in ("commission.json", "report.html", *["design.toml"] * (first != "certificate")):
        (out / name).unlink()


# --- a cluster ------------------------------------------------------------------------------------


class Cluster:
    """A scheduler and two workers that are killed or frozen, and what runs on them."""

    def __init__(self, campaign):
        self._campaign, self._rng = campaign, campaign.rng
        self._folder = campaign.folder / "machines"
        self._folder.mkdir()
        self.client = self._command("client", "longer", "60")
        self._start()

    def _command(self, kind, name, timeout):
        """A sweep on these workers."""
        at = "--workers", "../../machines/scheduler.json", "--worker-timeout", timeout
        return Command(kind, ("sweep", f"../../{name}.toml", *ON, *at))

    def _start(self):
        (self._folder / "scheduler.json").unlink(missing_ok=True)
        self._machines = Machines(self._folder)
        for _ in range(2):
            self._machines.add_worker()

    def measure(self):
        """Run a sweep without kills, which also says how long one takes."""
        self._span = self._whole().duration

    def stop(self):
        """End all its processes."""
        self._machines.stop()

    def kill_client(self, count):
        self._campaign.kills(self.client, count)

    def kill_workers(self, count):
        """Kill workers while a sweep runs, which ends whole."""
        command, done = self._command("worker", "longer", "60"), 0
        while done < count:
            place = self._campaign.fresh(command)
            process, hits = self._campaign.begin(command, place), 0
            for _ in range(min(2, count - done)):
                hits += len(self._struck(process, signal.SIGKILL))
            self._end(command, process, place, hits)
            done += hits

    def freeze_worker(self, count):
        """Freeze a worker, whose work is done elsewhere; later clients are told that it hangs."""
        command, done = self._command("frozen worker", "longer", "15"), 0
        while done < count:
            place = self._campaign.fresh(command)
            process = self._campaign.begin(command, place)
            struck = self._struck(process, signal.SIGSTOP)
            code = process.wait(timeout=LIMIT)
            for pid in struck:  # one that had nothing to do
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGCONT)
            if code and "restart workers that hang" not in said(place):
                self._fault(command, place, code)
            if code:
                process = self._campaign.begin(command, place)
            self._end(command, process, place, len(struck))
            done += len(struck)

    def _struck(self, process, number):
        """Send a worker a signal at a random moment of a process; its number, if it still runs."""
        self._wait(process)
        pids = self._machines.pids() if process.poll() is None else []
        chosen = [self._rng.choice(pids)] if pids else []
        for pid in chosen:
            os.kill(pid, number)
        return chosen

    def _wait(self, process):
        """Wait until a random moment of a sweep."""
        start = time.monotonic()
        with suppress(subprocess.TimeoutExpired):
            process.wait(timeout=self._rng.random() * self._span)
            self._span = min(self._span, time.monotonic() - start)  # all is compiled by now

    def kill_scheduler(self, count):
        """Kill the scheduler: the client says so, and goes on with the next one."""
        command, done = self.client._replace(kind="scheduler"), 0
        while done < count:
            place = self._campaign.fresh(command)
            process = self._campaign.begin(command, place)
            self._wait(process)
            self._machines.processes[0].kill()
            code = process.wait(timeout=LIMIT)
            self.stop()
            self._start()
            if code not in (0, 2) or (code and "scheduler" not in said(place)):
                self._fault(command, place, code)
            self._end(command, self._campaign.begin(command, place), place, int(code != 0))
            done += code != 0

    def poison(self, count):
        """A chunk kills its workers until it is given up; without poison the next call runs it."""
        command = self.client._replace(kind="poisoned chunk")
        for _ in range(count):
            place = self._campaign.fresh(command)
            n_cases = len(self._whole().contents["out/results.h5"]["case_id"])
            self._machines.trouble(kill=self._rng.randrange(n_cases))
            code = self._campaign.begin(command, place).wait(timeout=LIMIT)
            if "are left out" not in said(place):
                self._fault(command, place, code)
            self._machines.trouble()
            self._end(command, self._campaign.begin(command, place), place, 1)

    def kill_of_two(self, count):
        """Two sweeps at once on the same workers, of which some are killed."""
        commands = [self._command("two at once", name, "60") for name in ("longer", "stiffer")]
        wholes, done = [self._campaign.whole(command) for command in commands], 0
        while done < count:
            places = [self._campaign.fresh(command) for command in commands]
            processes = [self._campaign.begin(*x) for x in zip(commands, places, strict=True)]
            hits = len(self._struck(processes[0], signal.SIGKILL))
            self._end(commands[0], processes[0], places[0], hits, wholes[0])
            self._end(commands[1], processes[1], places[1], 0, wholes[1])
            done += hits

    def _whole(self):
        return self._campaign.whole(self.client)

    def _end(self, command, process, place, hits, whole=None):
        """Wait for the end of a command, and judge what it has left."""
        if code := process.wait(timeout=LIMIT):
            self._fault(command, place, code)
        self._campaign.judge(command.kind, place, whole or self._whole(), hits)

    def _fault(self, command, place, code):
        text = f"{place}: exit code {code}: {said(place)[-300:]}"
        self._campaign.tally(command.kind).faults.append(text)


#: By kind of kill: how it is done.
ON_A_CLUSTER = {
    "client": Cluster.kill_client,
    "worker": Cluster.kill_workers,
    "frozen worker": Cluster.freeze_worker,
    "scheduler": Cluster.kill_scheduler,
    "poisoned chunk": Cluster.poison,
    "two at once": Cluster.kill_of_two,
}


def run_campaign(folder, seed, counts, tell=lambda kind, tally: None):
    """Kill commands so often, by kind; tallies by kind."""
    campaign = Campaign(folder, seed)
    write_files(campaign.folder)
    for kind, count in counts.items():
        if kind == COMMISSION.kind:
            kill_commission(campaign, count)
        elif kind in COMMANDS:
            kill_command(campaign, kind, count)
        if kind in campaign.tallies:
            tell(kind, campaign.tallies[kind])
    on_cluster = {kind: count for kind, count in counts.items() if kind in ON_A_CLUSTER}
    if on_cluster:
        cluster = Cluster(campaign)
        try:
            cluster.measure()
            for kind, count in on_cluster.items():
                ON_A_CLUSTER[kind](cluster, count)
                tell(kind, campaign.tallies[kind])
        finally:
            cluster.stop()
    return campaign.tallies
