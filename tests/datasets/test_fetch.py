"""Downloads from a server on this machine that breaks off, lies, or changes its mind."""

import io
import json
import shutil
import threading
import zipfile
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

from ambiguous_wild.core import AwError
from ambiguous_wild.datasets import fetch as fetching
from ambiguous_wild.datasets.fetch import PublicData, fetch, find_public, public_data
from ambiguous_wild.datasets.readers import READERS
from ambiguous_wild.io.files import sha256_file
from tests.command_line import aw


def archive(text: str = "photo") -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as packed:
        packed.writestr("scene/images/a.txt", text * 5000)
    return out.getvalue()


class Server:
    """Serves `content`; `plan` holds what to do in each request, then it behaves."""

    def __init__(self) -> None:
        self.content, self.etag, self.plan, self.ranges = archive(), '"one"', [], []
        outer = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def log_message(self, *words) -> None:
                pass

            def do_GET(self) -> None:
                outer.serve(self)

        self.http = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        threading.Thread(target=self.http.serve_forever, daemon=True).start()
        self.url = f"http://127.0.0.1:{self.http.server_port}/scene.zip"

    def serve(self, handler) -> None:
        do = self.plan.pop(0) if self.plan else "all"
        asked = handler.headers.get("Range")
        self.ranges.append(asked)
        tag = handler.headers.get("If-Range")
        start = int(asked.removeprefix("bytes=").rstrip("-")) if asked and tag in (None, self.etag) else 0
        if do == "ignores range":
            start = 0
        if do in ("404", "503"):
            handler.send_error(int(do))
            return
        body = self.content[start:]
        handler.send_response(206 if start else 200)
        handler.send_header("ETag", self.etag)
        if start:
            place = start - 1 if do == "wrong place" else start
            handler.send_header("Content-Range", f"bytes {place}-{len(self.content) - 1}/{len(self.content)}")
        announced = len(body) + (500 if do == "lies long" else 0)
        handler.send_header("Content-Length", str(announced))
        handler.send_header("Connection", "close")
        handler.end_headers()
        handler.wfile.write(body[: len(body) // 2] if do == "breaks off" else body)
        handler.close_connection = True


@pytest.fixture
def server():
    made = Server()
    yield made
    made.http.shutdown()
    made.http.server_close()


def data(server, **other):
    return PublicData(
        "toy", "https://example.org", "CC0-1.0", "a toy", url=server.url, layout="colmap", **other
    )


def get(server, folder, **other):
    wanted = {k: other.pop(k) for k in ("sha256",) if k in other}
    return fetch(data(server, **wanted), folder, wait_s=0.0, **other)


def test_download_unpack_and_record(server, tmp_path):
    done = get(server, tmp_path)
    assert done.archive.read_bytes() == server.content and done.first
    assert (tmp_path / "toy" / "scene" / "images" / "a.txt").read_text().startswith("photo")
    known = json.loads((tmp_path / "archives" / "downloads.json").read_text())
    assert known["toy"] == {"url": server.url, "sha256": done.sha256, "bytes": len(server.content)}
    shutil.rmtree(done.folder)
    done.folder.mkdir()  # an empty folder counts as none
    again = get(server, tmp_path)
    assert (tmp_path / "toy" / "scene" / "images" / "a.txt").is_file()
    assert again.downloaded == 0 and not again.first and len(server.ranges) == 1


def test_it_goes_on_where_the_server_broke_off(server, tmp_path):
    server.plan = ["breaks off", "breaks off"]
    done = get(server, tmp_path)
    size = len(server.content)
    assert done.archive.read_bytes() == server.content
    assert server.ranges == [None, f"bytes={size // 2}-", f"bytes={size // 2 + (size - size // 2) // 2}-"]
    assert done.downloaded == size
    assert sorted(p.name for p in (tmp_path / "archives").iterdir()) == ["downloads.json", "toy.zip"]


def test_a_later_call_goes_on_too(server, tmp_path):
    server.plan = ["breaks off"]
    with pytest.raises(AwError, match="run the same command again to go on"):
        get(server, tmp_path, tries=1)
    assert not (tmp_path / "toy").exists()
    done = get(server, tmp_path)
    assert done.archive.read_bytes() == server.content
    assert done.downloaded == len(server.content) - len(server.content) // 2


@pytest.mark.parametrize("lie", ["ignores range", "wrong place", "lies long", "503"])
def test_a_server_that_lies_once(lie, server, tmp_path):
    server.plan = ["breaks off", lie]
    done = get(server, tmp_path)
    assert done.archive.read_bytes() == server.content


def test_a_length_that_is_never_true_is_not_taken(server, tmp_path):
    server.plan = ["lies long"] * 9
    with pytest.raises(AwError, match="broke off 3 times"):
        get(server, tmp_path, tries=3)
    assert not (tmp_path / "archives" / "toy.zip").exists()


def test_a_file_that_changes_between_two_parts_is_fetched_anew(server, tmp_path):
    server.plan = ["breaks off"]
    with pytest.raises(AwError):
        get(server, tmp_path, tries=1)
    server.content, server.etag = archive("other"), '"two"'
    assert get(server, tmp_path).archive.read_bytes() == server.content


@pytest.mark.parametrize("text", ["phot0", "much longer"])
def test_another_file_on_another_day_is_refused(text, server, tmp_path):
    """phot0: the same length, found by its hash; the other by its length before it is downloaded."""
    get(server, tmp_path)
    (tmp_path / "archives" / "toy.zip").unlink()
    server.content = archive(text)
    with pytest.raises(AwError, match="another file"):
        get(server, tmp_path)
    assert not (tmp_path / "archives" / "toy.zip").exists()


def test_a_hash_of_the_registry_is_checked_at_once(server, tmp_path):
    with pytest.raises(AwError, match="the registry states 0000"):
        get(server, tmp_path, sha256="0" * 64)
    assert not (tmp_path / "toy").exists()
    (tmp_path / "one").mkdir()
    good = tmp_path / "good.zip"
    good.write_bytes(server.content)
    assert not get(server, tmp_path / "one", sha256=sha256_file(good)).first


def test_an_archive_changed_on_this_disk_is_refused(server, tmp_path):
    done = get(server, tmp_path)
    done.archive.write_bytes(archive("mine!"))
    with pytest.raises(AwError, match="changed here"):
        get(server, tmp_path)


def test_hostile_archives_leave_nothing(server, tmp_path):
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as packed:
        packed.writestr("../escaped.txt", "x")
    server.content = out.getvalue()
    with pytest.raises(AwError, match="leads out of the folder"):
        get(server, tmp_path)
    assert not (tmp_path / "toy").exists() and not (tmp_path.parent / "escaped.txt").exists()


def test_absent_and_unreachable(server, tmp_path):
    server.plan = ["404"]
    with pytest.raises(AwError, match="answers 404"):
        get(server, tmp_path)
    closed = PublicData("toy", "", "", "", url="http://127.0.0.1:9/a.zip")
    with pytest.raises(AwError, match="no connection"):
        fetch(closed, tmp_path, tries=1)
    with pytest.raises(AwError, match="neither http nor https"):
        fetch(PublicData("toy", "", "", "", url="file:///etc/passwd"), tmp_path)


def test_the_registry_is_whole():
    known = public_data()
    assert len(known) >= 10
    for entry in known.values():
        assert entry.license and entry.page.startswith("https://")
        if entry.url:
            assert entry.layout in READERS and entry.url.startswith("https://")
    with pytest.raises(AwError, match="did you mean 'robustnerf'"):
        find_public("robustnerv")
    with pytest.raises(AwError, match="download it from"):
        find_public("dronesplat")


def test_as_it_is_typed(server, tmp_path, monkeypatch):
    listed = aw("fetch")
    assert listed.returncode == 0 and "Apache-2.0" in listed.stdout
    monkeypatch.setattr("ambiguous_wild.datasets.fetch.public_data", lambda: {"toy": data(server)})
    done = aw("fetch", "toy", "-o", tmp_path / "sets")
    assert done.returncode == 0 and "recorded now" in done.stdout
    assert fetching.RECORD in {p.name for p in (tmp_path / "sets" / "archives").iterdir()}
