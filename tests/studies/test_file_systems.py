"""File systems that fail: without locks, without room, or gone in mid-run."""

import errno
import fcntl
import os
import shutil
import tempfile

import pytest

from studies.engine.folder import BASELINE
from studies.errors import StudyError
from studies.job import LOCK, locked_folder
from studies.publish import working_folder
from studies.store import write_store
from studies.sweeps import run as sweeps
from tests.studies.test_exit_codes import Losing
from tests.sweeps import run_sweep, small_spec


@pytest.mark.parametrize("code", [errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS])
def test_a_file_system_without_locks_is_refused_in_words(tmp_path, monkeypatch, code):
    def flock(*_):
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(fcntl, "flock", flock)
    refused = pytest.raises(StudyError, match="cannot be locked .*; name a folder on another file")
    with refused, locked_folder(tmp_path / "out", "sweep"):
        pass


def test_a_folder_in_use_is_another_matter(tmp_path):
    refused = pytest.raises(StudyError, match="another process is at work on a sweep there")
    with locked_folder(tmp_path, "sweep"), refused, locked_folder(tmp_path, "sweep"):
        pass
    assert (tmp_path / LOCK).exists()


def test_a_folder_removed_in_mid_run_ends_in_a_message(tmp_path, monkeypatch):
    """Wherever the next file is written, here the baseline's; no case is run."""
    out = tmp_path / "out"

    def remove(spec, table, folder, say):
        shutil.rmtree(folder)
        write_store(folder / BASELINE, {}, {})

    monkeypatch.setattr(sweeps, "keep_baseline", remove)
    spec = small_spec({"axes": {"gain": [0.1, 0.5]}})
    with pytest.raises(StudyError, match="out: was renamed or removed while work went on in it"):
        run_sweep(spec, out, runner=Losing())
    assert not out.exists()


def test_without_room_for_temporary_files_a_message_says_what_to_do(monkeypatch):
    full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    with pytest.raises(StudyError, match="No space left .*TMPDIR"), working_folder() as folder:
        raise full
    assert not folder.exists()
    with pytest.raises(OSError, match="is not this one's"), working_folder():
        raise OSError(errno.ENOENT, "is not this one's")

    def make():
        raise FileNotFoundError(errno.ENOENT, "No usable temporary directory found")

    monkeypatch.setattr(tempfile, "TemporaryDirectory", make)
    refused = pytest.raises(StudyError, match="temporary files: cannot write .*TMPDIR")
    with refused, working_folder():
        pass
