"""Folders as archives, and archives in memory: what is packed comes back, nothing leaves the target."""

import io
import tarfile

import pytest

from ambiguous_wild.core import AwError
from ambiguous_wild.io.archive import Limits, pack_folder, unpack

SMALL = Limits(bytes=1_000_000)


def tree(folder):
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def archive(*members, mode="w:gz"):
    """A tar of (name, content or type)."""
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode=mode) as tar:
        for name, content in members:
            member = tarfile.TarInfo(name)
            if isinstance(content, bytes):
                member.size = len(content)
                tar.addfile(member, io.BytesIO(content))
            else:
                member.type, member.linkname = content[0], "/etc/passwd"
                tar.addfile(member)
    return buffer.getvalue()


def test_a_folder_comes_back_as_it_was_without_what_is_hidden(tmp_path):
    source, target = tmp_path / "a", tmp_path / "b"
    for name in ("x.txt", "deep/er/y.bin", ".lock", "deep/.cache/z"):
        path = source / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(name.encode())
    (tmp_path / "real.txt").write_text("behind a link")
    (source / "link.txt").symlink_to(tmp_path / "real.txt")
    target.mkdir()
    names = unpack(pack_folder(source, 1.0), target, SMALL)
    assert tree(target) == {
        "x.txt": b"x.txt",
        "deep/er/y.bin": b"deep/er/y.bin",
        "link.txt": b"behind a link",
    }
    assert sorted(names) == sorted(tree(target))
    assert not (target / "link.txt").is_symlink()


def test_too_much_is_refused_both_ways(tmp_path):
    (tmp_path / "big").write_bytes(bytes(3_000_000))
    with pytest.raises(AwError, match="3 MB, more than the 2 MB"):
        pack_folder(tmp_path, 2.0)
    small = archive(("bomb", bytes(3_000_000)))
    assert len(small) < 10_000
    target = tmp_path / "out"
    target.mkdir()
    with pytest.raises(AwError, match="more than 2 MB"):
        unpack(small, target, Limits(bytes=2_000_000))
    assert sum(map(len, tree(target).values())) <= 2_000_000


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("../out.txt", b"x", "leads out"),
        ("/tmp/out.txt", b"x", "leads out"),
        ("a/../../out.txt", b"x", "leads out"),
        ("..\\out.txt", b"x", "leads out"),
        ("link", [tarfile.SYMTYPE], "a link, device"),
        ("hard", [tarfile.LNKTYPE], "a link, device"),
        ("pipe", [tarfile.FIFOTYPE], "a link, device"),
        ("dev", [tarfile.CHRTYPE], "a link, device"),
    ],
)
def test_hostile_members_are_refused(tmp_path, name, content, message):
    target = tmp_path / "in"
    target.mkdir()
    with pytest.raises(AwError, match=message):
        unpack(archive((name, content)), target, SMALL)
    assert tree(tmp_path) == {} and list(target.iterdir()) == []


def test_a_name_twice_and_a_cut_file_are_refused(tmp_path):
    with pytest.raises(AwError, match="the same file"):
        unpack(archive(("a", b"1"), ("a", b"2")), tmp_path, SMALL)
    path = tmp_path / "cut.tar.gz"
    path.write_bytes(archive(("b", bytes(range(256)) * 50))[:-30])
    with pytest.raises(AwError, match="damaged or cut"):
        unpack(path, tmp_path, SMALL)
    with pytest.raises(AwError, match="cannot unpack"):
        unpack(tmp_path / "absent.tar", tmp_path, SMALL)


def test_only_what_is_wanted_is_written(tmp_path):
    unpack(
        archive(("color/a.png", b"1"), ("gt/a.png", b"2")), tmp_path, SMALL, wanted=lambda n: n[:2] == "co"
    )
    assert tree(tmp_path) == {"color/a.png": b"1"}
