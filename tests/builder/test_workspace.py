import errno
import fcntl
import os
import shutil
import time
from types import SimpleNamespace

import pytest

from ambiguous_wild.builder.workspace import Workspace, content_key
from ambiguous_wild.core import AwError
from ambiguous_wild.io.files import folder_lock


def test_a_stage_runs_once_for_the_same_inputs(tmp_path):
    calls = []

    def work(folder):
        calls.append(folder)
        (folder / "out.txt").write_text("x")
        return {"n": len(calls)}

    first = Workspace(tmp_path / "w").run("stage", {"a": 1}, work)
    again = Workspace(tmp_path / "w").run("stage", {"a": 1}, work)
    assert len(calls) == 1
    assert (first.reused, again.reused) == (False, True)
    assert again.facts == {"n": 1}
    assert (again.folder / "out.txt").read_text() == "x"
    other = Workspace(tmp_path / "w").run("stage", {"a": 2}, work)
    assert other.facts == {"n": 2}
    assert other.folder != first.folder


def test_a_stage_under_the_name_of_another_is_made_anew(tmp_path):
    def work(folder):
        return {"n": len(folder.name)}

    first, other = (Workspace(tmp_path).run("stage", a, work) for a in (1, 2))
    shutil.rmtree(other.folder)
    shutil.copytree(first.folder, other.folder)
    assert [Workspace(tmp_path).run("stage", a, work).reused for a in (1, 2, 2)] == [True, False, True]
    (first.folder / "stage.json").write_text("{")
    assert not Workspace(tmp_path).run("stage", 1, work).reused


def test_time_of_a_result_that_is_used_again_counts_once(tmp_path):
    def slow(folder):
        time.sleep(0.01)
        return {}

    work = Workspace(tmp_path / "w")
    spent = [work.run("stage", {"a": a}, slow).seconds for a in (1, 1, 2, 1)]
    assert work.seconds() == {"stage": round(spent[0] + spent[2], 3)}


def test_a_stage_that_fails_on_a_full_disk_says_so_and_runs_again(tmp_path, monkeypatch):
    def crash(folder):
        raise AwError("COLMAP ended with code 1: its log is empty")

    with monkeypatch.context() as patch:
        patch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=4096))
        with pytest.raises(OSError, match=r"No space left.*features-") as raised:
            Workspace(tmp_path).run("features", {}, crash)
    assert raised.value.errno == errno.ENOSPC and not os.listdir(tmp_path)
    with pytest.raises(AwError, match="log is empty"):
        Workspace(tmp_path).run("features", {}, crash)
    assert not Workspace(tmp_path).run("features", {}, lambda folder: {}).reused


def test_a_stage_that_fails_leaves_no_folder(tmp_path):
    def work(folder):
        (folder / "half.txt").write_text("x")
        raise RuntimeError("disk full")

    with pytest.raises(RuntimeError):
        Workspace(tmp_path / "w").run("stage", 1, work)
    assert list((tmp_path / "w").iterdir()) == []


def test_leftovers_of_a_killed_stage_are_cleared(tmp_path):
    (tmp_path / "w" / ".stage-abc.tmp-xyz").mkdir(parents=True)
    Workspace(tmp_path / "w")
    assert list((tmp_path / "w").iterdir()) == []


def test_keys_see_every_part_and_not_the_order_of_dicts():
    assert content_key("a", {"x": 1, "y": 2}) == content_key("a", {"y": 2, "x": 1})
    assert len({content_key("a", 1), content_key("a", 2), content_key("b", 1), content_key("a", "1")}) == 4


def test_a_lock_file_left_by_a_kill_does_not_block(tmp_path):
    (tmp_path / ".scene.lock").write_text("process 1 since 00:00:00")
    with (
        folder_lock(tmp_path / "scene", "aw build-scene"),
        open(tmp_path / ".scene.lock") as handle,
        pytest.raises(BlockingIOError),
    ):
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
