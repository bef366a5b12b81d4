"""Archives: what is whole comes out, what is hostile leaves nothing behind."""

import bz2
import gzip
import io
import os
import stat
import tarfile
import zipfile

import pytest

from ambiguous_wild.core import AwError
from ambiguous_wild.io.archive import Limits, extract, pack_folder, unpack

SMALL = Limits(bytes=1_000_000)
FILES = {"scene/a.txt": b"one", "scene/images/é.png": bytes(range(256)), "b.txt": b""}


def tar_of(*members, mode="w"):
    """A tar of (TarInfo or name, data)."""
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode=mode) as archive:
        for member, data in members:
            info = member if isinstance(member, tarfile.TarInfo) else tarfile.TarInfo(member)
            if data is not None:
                info.size = len(data)
            archive.addfile(info, None if data is None else io.BytesIO(data))
    return out.getvalue()


def zip_of(*members, method=zipfile.ZIP_DEFLATED):
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", method) as archive:
        for name, data in members:
            archive.writestr(name, data)
    return out.getvalue()


def special(kind, target=""):
    info = tarfile.TarInfo("odd")
    info.type, info.linkname = kind, target
    return info


def zip_link():
    info = zipfile.ZipInfo("link")
    info.external_attr = (stat.S_IFLNK | 0o777) << 16
    return info


WHOLE = {
    "zip": zip_of(*FILES.items()),
    "zip stored": zip_of(*FILES.items(), method=zipfile.ZIP_STORED),
    "tar": tar_of(*FILES.items()),
    "tar.gz": gzip.compress(tar_of(*FILES.items())),
    "tar.bz2": bz2.compress(tar_of(*FILES.items())),
}
ZEROS = bytes(65 << 20)
HOSTILE = {
    "zip climbs": (zip_of(("../out.txt", b"x")), "leads out"),
    "zip climbs inside": (zip_of(("a/../../out.txt", b"x")), "leads out"),
    "zip absolute": (zip_of(("/tmp/out.txt", b"x")), "leads out"),
    "zip of Windows": (zip_of(("a\\..\\..\\out.txt", b"x")), "leads out"),
    "zip drive": (zip_of(("C:out.txt", b"x")), "leads out"),
    "zip link": (zip_of((zip_link(), b"/etc/passwd")), "link"),
    "zip twice": (zip_of(("a.txt", b"x"), ("A.TXT", b"y")), "the same file"),
    "zip bomb": (zip_of(("zeros", ZEROS)), "bomb"),
    "zip long name": (zip_of(("x" * 300, b"x")), "too long"),
    "zip bell": (zip_of(("a\x07b", b"x")), "an invalid file name"),
    "zip method": (zip_of(("a", b"x" * 99), method=zipfile.ZIP_LZMA), "method"),
    "tar climbs": (tar_of(("../out.txt", b"x")), "leads out"),
    "tar absolute": (tar_of(("/tmp/out.txt", b"x")), "leads out"),
    "tar symlink": (tar_of((special(tarfile.SYMTYPE, "/etc"), None)), "link"),
    "tar hard link": (tar_of((special(tarfile.LNKTYPE, "../../x"), None)), "link"),
    "tar device": (tar_of((special(tarfile.CHRTYPE), None)), "device"),
    "tar fifo": (tar_of((special(tarfile.FIFOTYPE), None)), "device"),
    "tar twice": (tar_of(("a", b"x"), ("a", b"y")), "the same file"),
    "tar bomb": (gzip.compress(tar_of(("zeros", ZEROS))), "bomb"),
    "deep": (zip_of(("a/" * 40 + "b", b"x")), "an invalid file name"),
    "xz": (b"\xfd7zXZ\0" + bytes(40), "xz"),
    "text": (b"no archive at all, only text" * 40, "damaged or cut"),
    "empty": (b"", "damaged or cut"),
    "cut zip": (WHOLE["zip"][:-30], "damaged or cut"),
    "cut tar.gz": (WHOLE["tar.gz"][:-30], "damaged or cut"),
}


@pytest.mark.parametrize("kind", WHOLE)
def test_what_is_whole_comes_out(tmp_path, kind):
    path = tmp_path / "download"  # known by content, whatever it is called
    path.write_bytes(WHOLE[kind])
    assert extract(path, tmp_path / "out") == sorted(FILES)
    assert {n: (tmp_path / "out" / n).read_bytes() for n in FILES} == FILES
    assert sorted(os.listdir(tmp_path)) == ["download", "out"]


def test_a_tar_that_ends_with_a_zip_is_a_tar(tmp_path):
    (tmp_path / "download").write_bytes(tar_of(("a.txt", b"a"), ("masks.zip", WHOLE["zip"])))
    assert extract(tmp_path / "download", tmp_path / "out") == ["a.txt", "masks.zip"]


@pytest.mark.parametrize("kind", HOSTILE)
def test_what_is_hostile_or_damaged_leaves_nothing(tmp_path, kind):
    data, reason = HOSTILE[kind]
    room = tmp_path / "room"
    room.mkdir()
    (room / "archive").write_bytes(data)
    with pytest.raises(AwError, match=reason):
        extract(room / "archive", room / "out")
    assert os.listdir(room) == ["archive"]
    assert os.listdir(tmp_path) == ["room"]


def test_a_header_that_unpacks_to_gigabytes_is_stopped(tmp_path):
    """A PAX header of 8 MB packs to 8 kB; tarfile would read one of any size into memory."""
    info = tarfile.TarInfo("a")
    info.pax_headers = {"comment": "x" * (8 << 20)}
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w", format=tarfile.PAX_FORMAT) as archive:
        archive.addfile(info)
    (tmp_path / "a.tar.gz").write_bytes(gzip.compress(out.getvalue(), 1))
    with pytest.raises(AwError, match="header"):
        extract(tmp_path / "a.tar.gz", tmp_path / "out")
    assert os.listdir(tmp_path) == ["a.tar.gz"]


def test_limits_on_files_and_bytes(tmp_path):
    path = tmp_path / "a.zip"
    path.write_bytes(WHOLE["zip"])
    with pytest.raises(AwError, match="more than 2 files"):
        extract(path, tmp_path / "out", Limits(files=2))
    with pytest.raises(AwError, match="bomb"):
        extract(path, tmp_path / "out", Limits(bytes=100))
    assert os.listdir(tmp_path) == ["a.zip"]


def test_nothing_is_overwritten(tmp_path):
    (tmp_path / "a.zip").write_bytes(WHOLE["zip"])
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine").write_text("all I have")
    with pytest.raises(AwError, match="exists"):
        extract(tmp_path / "a.zip", tmp_path / "out")
    assert os.listdir(tmp_path / "out") == ["mine"]


def tree(folder):
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_a_folder_comes_back_as_it_was_without_what_is_hidden(tmp_path):
    source, target = tmp_path / "a", tmp_path / "b"
    for name in ("x.txt", "deep/er/y.bin", ".lock", "deep/.cache/z"):
        path = source / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(name.encode())
    (tmp_path / "real.txt").write_text("behind a link")
    (source / "link.txt").symlink_to(tmp_path / "real.txt")
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "p.jpg").write_text("of a linked folder")
    (source / "images").symlink_to(tmp_path / "photos")
    (source / "deep" / "round").symlink_to(source)
    target.mkdir()
    names = unpack(pack_folder(source, 1.0), target, SMALL)
    assert tree(target) == {
        "x.txt": b"x.txt",
        "deep/er/y.bin": b"deep/er/y.bin",
        "link.txt": b"behind a link",
        "images/p.jpg": b"of a linked folder",
    }
    assert sorted(names) == sorted(tree(target))
    assert not (target / "link.txt").is_symlink() and not (target / "images").is_symlink()


def test_too_much_is_refused_both_ways(tmp_path):
    (tmp_path / "big").write_bytes(bytes(3_000_000))
    with pytest.raises(AwError, match="3 MB, more than the 2 MB"):
        pack_folder(tmp_path, 2.0)
    small = tar_of(("bomb", bytes(3_000_000)), mode="w:gz")
    assert len(small) < 10_000
    target = tmp_path / "out"
    target.mkdir()
    with pytest.raises(AwError, match="more than 2 MB"):
        unpack(small, target, Limits(bytes=2_000_000))
    assert sum(map(len, tree(target).values())) <= 2_000_000


def test_only_what_is_wanted_is_written(tmp_path):
    unpack(tar_of(("color/a.png", b"1"), ("gt/a.png", b"2")), tmp_path, SMALL, wanted=lambda n: n[:2] == "co")
    assert tree(tmp_path) == {"color/a.png": b"1"}
