"""Packages: the same bytes twice, every changed bit found, nothing private inside."""

import csv
import io
import json
import shutil
import struct
import zipfile
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from ambiguous_wild.core import AwError
from ambiguous_wild.datasets.package import package_scenes
from ambiguous_wild.datasets.package_check import verify
from ambiguous_wild.datasets.privacy import strip_metadata
from ambiguous_wild.datasets.release_facts import TEMPLATE, ReleaseInfo, read_release_info
from ambiguous_wild.datasets.write import import_scene
from ambiguous_wild.io.scene_folder import load_scene
from tests.command_line import aw
from tests.datasets import layouts

INFO = ReleaseInfo(
    title="Toy",
    description="Waves.",
    creators=("Ada",),
    license="CC-BY-4.0",
    consent="nobody is seen",
    contact="ada@example.org",
    date="2026-11-23",
    cite_as="Ada, 2026",
)
SECRET = b"SERIAL-4711"


def jpeg_with_metadata(pixels):
    """A JPEG with EXIF, XMP, a comment and a preview behind its end, all holding a serial number."""
    data = cv2.imencode(".jpg", pixels)[1].tobytes()

    def segment(marker, body):
        return bytes([0xFF, marker]) + struct.pack(">H", len(body) + 2) + body

    extra = segment(0xE1, b"Exif\0\0" + SECRET) + segment(0xE1, b"http://ns.adobe.com/xap/1.0/\0" + SECRET)
    return data[:2] + extra + segment(0xFE, SECRET) + data[2:] + SECRET


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """An imported scene, two of whose photos are JPEGs with metadata, the second called .jfif."""
    base = tmp_path_factory.mktemp("release")
    root = layouts.native(base / "raw")
    for index, suffix in enumerate((".jpg", ".jfif")):
        name = layouts.TRAIN[index]
        (root / "images" / name).unlink()
        jpeg = jpeg_with_metadata(layouts.photo(index))
        (root / "images" / f"{Path(name).stem}{suffix}").write_bytes(jpeg)
    scene = import_scene(root, base / "toy").scene
    info = json.loads((scene / "scene.json").read_text())
    score = {"value": 0.41, "low": 0.35, "high": 0.47}
    info["ambiguity"] = {"class": "ambiguous in colour", "colour_share": score}
    (scene / "scene.json").write_text(json.dumps(info))
    return scene


@pytest.fixture(scope="module")
def package(scene, tmp_path_factory):
    folder = tmp_path_factory.mktemp("package") / "out"
    package_scenes([scene], folder, INFO)
    return folder


def test_two_packages_of_one_scene_have_the_same_bytes(scene, package, tmp_path):
    copy = tmp_path / "elsewhere"
    shutil.copytree(scene, copy)
    package_scenes([copy], tmp_path / "again", INFO, jobs=2)
    for path in sorted(package.iterdir()):
        assert path.read_bytes() == (tmp_path / "again" / path.name).read_bytes(), path.name


def test_it_verifies_and_opens_as_the_scene(scene, package, tmp_path):
    found = verify(package)
    assert found.scenes == ["toy"] and found.warnings == []
    with zipfile.ZipFile(package / "toy.zip") as archive:
        assert all(i.compress_type == zipfile.ZIP_STORED for i in archive.infolist())
        archive.extractall(tmp_path)
    a, b = load_scene(tmp_path / "toy"), load_scene(scene)
    assert [(v.name, v.split) for v in a.views] == [(v.name, v.split) for v in b.views]
    assert verify(package / "toy.zip").scenes == ["toy"]


def test_metadata_is_out_and_the_pixels_are_the_same(scene, package):
    with zipfile.ZipFile(package / "toy.zip") as archive:
        names = [n for n in archive.namelist() if n.endswith(".jpg")]
        data = archive.read(names[0])
        assert all(SECRET not in archive.read(n) for n in archive.namelist())
    original = (scene / names[0].removeprefix("toy/")).read_bytes()
    assert SECRET in original
    decoded = [cv2.imdecode(np.frombuffer(d, np.uint8), 1) for d in (data, original)]
    assert np.array_equal(*decoded)
    rows = list(csv.DictReader((package / "photos.csv").open()))
    row = next(r for r in rows if r["photo"].endswith(".jpg"))
    assert "EXIF" in row["metadata_removed"] and "comment" in row["metadata_removed"]
    assert row["split"] == "train" and row["done"] == "linked"


def test_metadata_stays_on_request(scene, tmp_path):
    package_scenes([scene], tmp_path / "out", INFO, keep_metadata=True, look_for_people=False)
    with zipfile.ZipFile(tmp_path / "out" / "toy.zip") as archive:
        assert any(SECRET in archive.read(n) for n in archive.namelist())
    assert "kept on request" in (tmp_path / "out" / "README.md").read_text()
    verify(tmp_path / "out")


def test_other_formats_lose_their_metadata_too():
    pixels = layouts.photo(0)
    png = cv2.imencode(".png", pixels)[1].tobytes()
    body = b"Comment\0" + SECRET
    chunk = struct.pack(">I", len(body)) + b"tEXt" + body + struct.pack(">I", zlib.crc32(b"tEXt" + body))
    clean, dropped = strip_metadata(png[:33] + chunk + png[33:] + SECRET, "a.png")
    assert clean == png and dropped[0] == "tEXt"
    webp = cv2.imencode(".webp", pixels, [cv2.IMWRITE_WEBP_QUALITY, 101])[1].tobytes()
    head = b"VP8X" + struct.pack("<I", 10) + bytes([0x08, 0, 0, 0]) + bytes([63, 0, 0, 35, 0, 0])
    exif = b"EXIF" + struct.pack("<I", 12) + (SECRET + b"\0\0")[:12]
    inner = b"WEBP" + head + webp[12:] + exif
    clean, dropped = strip_metadata(b"RIFF" + struct.pack("<I", len(inner)) + inner, "a.webp")
    assert SECRET not in clean and dropped == ["EXIF"]
    assert np.array_equal(cv2.imdecode(np.frombuffer(clean, np.uint8), 1), pixels)
    with pytest.raises(AwError, match="--keep-metadata"):
        strip_metadata(b"II*\0" + bytes(64), "a.tif")
    with pytest.raises(AwError, match="damaged"):
        strip_metadata(png[:40], "a.png")


def test_the_card_says_what_is_known(package):
    text = (package / "README.md").read_text()
    assert "colour_share 0.410 [0.350, 0.470]" in text and "nobody is seen" in text
    assert "NOT FOR RELEASE" not in text and "miss people" in text


def test_without_licence_and_consent_it_is_not_for_release(scene, tmp_path):
    done = aw("package", scene, "-o", tmp_path / "out", "--no-people")
    assert done.returncode == 0
    assert (
        "NOT FOR RELEASE: not stated: title, description, creators, license, consent, contact" in done.stdout
    )
    assert "NOT FOR RELEASE" in (tmp_path / "out" / "README.md").read_text()
    assert "NOT FOR RELEASE" in (tmp_path / "out" / "croissant.json").read_text()
    checked = aw("verify", tmp_path / "out")
    assert checked.returncode == 0 and "not for release" in checked.stdout


def test_every_flipped_bit_is_found(package, tmp_path):
    """One bit at a time, in every file of the package, at several places of the archive."""
    for name in sorted(p.name for p in package.iterdir()):
        size = (package / name).stat().st_size
        places = [size // 3] if not name.endswith(".zip") else [40, size // 4, size // 2, size - 60]
        for place in places:
            copy = tmp_path / f"{name}-{place}"
            shutil.copytree(package, copy)
            data = bytearray((copy / name).read_bytes())
            data[place] ^= 1
            (copy / name).write_bytes(bytes(data))
            with pytest.raises(AwError) as error:
                verify(copy)
            assert "\n" not in str(error.value)


def test_a_flipped_bit_is_found_in_an_archive_alone(package, tmp_path):
    data = bytearray((package / "toy.zip").read_bytes())
    place = data.index(b"\x89PNG") + 60
    data[place] ^= 1
    (tmp_path / "toy.zip").write_bytes(bytes(data))
    with pytest.raises(AwError, match="damaged"):
        verify(tmp_path / "toy.zip")


def _rezip(source, target, change):
    """The archive again with `change(name, data)`: the new bytes, or None to leave the member out."""
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(target, "w") as new:
        for name in old.namelist():
            data = change(name, old.read(name))
            if data is not None:
                new.writestr(name, data)


def test_hostile_archives_are_refused(package, tmp_path):
    with zipfile.ZipFile(tmp_path / "out.zip", "w") as archive:
        archive.writestr("../escaped.txt", "x")
    with pytest.raises(AwError, match="leads out of the folder"):
        verify(tmp_path / "out.zip")
    _rezip(package / "toy.zip", tmp_path / "more.zip", lambda n, d: d)
    with zipfile.ZipFile(tmp_path / "more.zip", "a") as archive:
        archive.writestr("toy/run.sh", "rm -rf /")
    with pytest.raises(AwError, match=r"does not list: run\.sh"):
        verify(tmp_path / "more.zip")

    def pointing_out(name, data):
        if not name.endswith("scene.json"):
            return data
        info = json.loads(data)
        info["files"]["../../etc/passwd"] = {"sha256": "0" * 64, "bytes": 1}
        return json.dumps(info).encode()

    _rezip(package / "toy.zip", tmp_path / "path.zip", pointing_out)
    with pytest.raises(AwError, match="outside itself"):
        verify(tmp_path / "path.zip")
    copy = tmp_path / "package"
    shutil.copytree(package, copy)
    (copy / "extra.html").write_text("<script>")
    with pytest.raises(AwError, match=r"do not list: extra\.html"):
        verify(copy)
    (copy / "extra.html").unlink()
    with (copy / "checksums.sha256").open("a") as f:
        f.write("0" * 64 + "  ../other\n")
    with pytest.raises(AwError, match="no checksum"):
        verify(copy)


def test_nothing_of_the_users_is_replaced(scene, package, tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("mine")
    with pytest.raises(AwError, match="is no package"):
        package_scenes([scene], tmp_path / "mine", INFO, look_for_people=False)
    with pytest.raises(AwError, match="lies inside the scene"):
        package_scenes([scene], scene / "package", INFO, look_for_people=False)
    copy = tmp_path / "package"
    shutil.copytree(package, copy)
    for name in ("notes.txt", "mine.zip"):
        (copy / name).write_text("mine")
        with pytest.raises(AwError, match=f"also holds {name}"):
            package_scenes([scene], copy, INFO, look_for_people=False)
        assert (copy / name).read_text() == "mine"
        (copy / name).unlink()
    card = (copy / "README.md").read_text(encoding="utf-8")
    (copy / "README.md").write_text(card + "Cite us.", encoding="utf-8")
    with pytest.raises(AwError, match=r"README\.md is not as this command wrote it"):
        package_scenes([scene], copy, INFO, look_for_people=False)
    (copy / "README.md").write_text(card, encoding="utf-8")
    assert package_scenes([scene], copy, INFO, look_for_people=False).stripped == 2


def test_a_plain_scene_must_be_imported_first(tmp_path):
    with pytest.raises(AwError, match="aw import"):
        package_scenes([layouts.native(tmp_path / "raw")], tmp_path / "out", INFO)


def test_the_template_is_read_back(tmp_path):
    words = ("package", "--info", tmp_path / "release.yaml")
    done = aw(*words)
    assert done.returncode == 0
    again = aw(*words)
    assert again.returncode == 2 and "exists; nothing is overwritten" in again.stderr
    assert "name the scene folders" in aw(*words, "-o", tmp_path / "out").stderr
    info = read_release_info(tmp_path / "release.yaml")
    assert info.lacking == ["title", "description", "creators", "license", "consent", "contact"]
    (tmp_path / "b.yaml").write_text(
        TEMPLATE.replace('license: ""', "license: CC-BY-4.0").replace("consent", "consnet")
    )
    with pytest.raises(AwError, match="did you mean 'consent'"):
        read_release_info(tmp_path / "b.yaml")


def test_people_are_listed(tmp_path):
    """The detectors find an upright figure and a face of known photos, and nothing in waves."""
    from skimage import data

    from ambiguous_wild.datasets.privacy import may_show_person

    cv2.imwrite(str(tmp_path / "face.png"), data.astronaut()[:, :, ::-1])
    cv2.imwrite(str(tmp_path / "waves.png"), np.kron(layouts.photo(0), np.ones((5, 5, 1), np.uint8)))
    assert "face" in may_show_person(tmp_path / "face.png")
    assert may_show_person(tmp_path / "waves.png") == ""


def test_mlcroissant_accepts_it_and_gives_the_files_with_their_hashes(package):
    mlc = pytest.importorskip("mlcroissant", reason="mlcroissant is not installed")
    dataset = mlc.Dataset(jsonld=str(package / "croissant.json"))
    assert not dataset.metadata.ctx.issues.errors
    rows = {(r["files/scene"].decode(), r["files/path"].decode()): r for r in dataset.records("files")}
    with zipfile.ZipFile(io.BytesIO((package / "toy.zip").read_bytes())) as archive:
        names = archive.namelist()
        assert len(rows) == len(names)
        import hashlib

        for name in names:
            row = rows["toy", name.removeprefix("toy/")]
            assert row["files/sha256"].decode() == hashlib.sha256(archive.read(name)).hexdigest()
            assert row["files/bytes"] == len(archive.read(name))
