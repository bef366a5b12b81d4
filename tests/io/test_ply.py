"""Splat PLY: the layout others read, round trips, and junk refused by name."""

import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ambiguous_wild.core import AwError
from ambiguous_wild.io.ply import has_splats, read_point_ply, read_splat_ply, stated_up, write_splat_ply


def model(n=5, rest=15, seed=0):
    rng = np.random.default_rng(seed)
    shapes = {"means": (n, 3), "quats": (n, 4), "log_scales": (n, 3), "opacity_logits": (n,), "sh0": (n, 3)}
    out = {name: rng.normal(size=shape).astype(np.float32) for name, shape in shapes.items()}
    return out | {"sh_rest": rng.normal(size=(n, rest, 3)).astype(np.float32)}


@pytest.mark.parametrize("rest", [0, 3, 8, 15])
@pytest.mark.parametrize("n", [0, 1, 7])
def test_round_trip_is_exact(tmp_path, n, rest):
    before = model(n, rest)
    write_splat_ply(tmp_path / "a.ply", before)
    after = read_splat_ply(tmp_path / "a.ply")
    assert after.keys() == before.keys()
    for name, array in before.items():
        assert after[name].dtype == np.float32
        np.testing.assert_array_equal(after[name], array)


def test_the_layout_is_the_one_viewers_expect(tmp_path):
    g = model(2, 3)
    write_splat_ply(tmp_path / "a.ply", g)
    data = (tmp_path / "a.ply").read_bytes()
    header, _, body = data.partition(b"end_header\n")
    lines = header.decode().splitlines()
    assert lines[:3] == ["ply", "format binary_little_endian 1.0", "element vertex 2"]
    names = [line.split()[2] for line in lines[3:]]
    assert names[:9] == ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    assert names[9:18] == [f"f_rest_{i}" for i in range(9)]
    assert names[18:] == ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    second = struct.unpack("<26f", body[26 * 4 :])
    # f_rest runs over the three coefficients of red, then of green, then of blue
    expected = [*g["means"][1], 0, 0, 0, *g["sh0"][1], *g["sh_rest"][1, :, 0], *g["sh_rest"][1, :, 1]]
    expected += [*g["sh_rest"][1, :, 2], g["opacity_logits"][1], *g["log_scales"][1], *g["quats"][1]]
    assert second == tuple(np.float32(v) for v in expected)


@pytest.mark.parametrize("form", ["binary_little_endian", "binary_big_endian", "ascii"])
def test_columns_in_another_order_type_and_form_are_understood(tmp_path, form):
    before = model(3, 0)
    columns = {"opacity": before["opacity_logits"]}
    for prefix, name in (("rot_", "quats"), ("scale_", "log_scales"), ("f_dc_", "sh0")):
        columns |= {f"{prefix}{i}": before[name][:, i] for i in range(before[name].shape[1])}
    columns |= {axis: before["means"][:, i] for i, axis in enumerate("xyz")}
    table = np.zeros(3, [("flag", "u1"), *((name, "<f8") for name in columns)])
    for name, values in columns.items():
        table[name] = values
    header = f"ply\r\nformat {form} 1.0\r\ncomment made elsewhere\r\nelement vertex 3\r\n"
    header += "property uchar flag\r\n" + "".join(f"property double {name}\r\n" for name in columns)
    path = tmp_path / "other.ply"
    body = table.astype(table.dtype.newbyteorder(">" if "big" in form else "<")).tobytes()
    if form == "ascii":
        body = "".join(" ".join(map(repr, row)) + "\r\n" for row in table.tolist()).encode()
    path.write_bytes(header.encode() + b"end_header\r\n" + body)
    after = read_splat_ply(path)
    for name, array in before.items():
        np.testing.assert_array_equal(after[name], array)


def test_disks_of_2dgs_become_flat_gaussians(tmp_path):
    before = model(4)
    before["log_scales"][:, 2] = np.log(1e-6)
    write_splat_ply(tmp_path / "a.ply", before)
    head, _, body = (tmp_path / "a.ply").read_bytes().partition(b"end_header\n")
    columns = np.frombuffer(body, "<f4").reshape(4, -1)
    head = head.replace(b"property float scale_2\n", b"") + b"end_header\n"
    (tmp_path / "a.ply").write_bytes(head + np.delete(columns, -5, axis=1).tobytes())
    after = read_splat_ply(tmp_path / "a.ply")
    for name, array in before.items():
        assert after[name].dtype == np.float32
        np.testing.assert_array_equal(after[name], array)


def test_junk_is_refused_by_name(tmp_path):
    path = tmp_path / "x.ply"
    write_splat_ply(path, model())
    whole = path.read_bytes()
    cases = {
        "does not start": b"PK\x03\x04" + whole,
        "no end of the PLY header": whole[:200],
        "cut short": whole[:-1],
        "cut short:": whole.replace(b"vertex 5", b"vertex 999999999999"),
        "element vertex": whole.replace(b"vertex 5", b"vertex -5"),
        "of format 'utf8', not binary_little_endian": whole.replace(b"binary_little_endian", b"utf8"),
        "cut short or damaged": whole.replace(b"binary_little_endian", b"ascii"),
        "aw bench --start": b"ply\nformat ascii 1.0\nelement vertex 1\n"
        + b"".join(b"property float %c\n" % a for a in b"xyz")
        + b"end_header\n0 0 0\n",
        "lacks": whole.replace(b"float opacity", b"float weight"),
        "cannot use vertex property": whole.replace(b"property float x", b"property list uchar int x"),
        "twice": whole.replace(b"property float y", b"property float x"),
        "f_rest columns": whole.replace(b"f_rest_44", b"g_rest_44"),
        "its property x is uint32, not float or double": whole.replace(b"float x", b"uint x"),
        "its property opacity is int32": whole.replace(b"float opacity", b"int opacity"),
        "names no vertices": b"ply\nformat binary_little_endian 1.0\nend_header\n",
    }
    for message, data in cases.items():
        path.write_bytes(data)
        with pytest.raises(AwError, match=message.rstrip(":")):
            read_splat_ply(path)
    with pytest.raises(AwError, match="cannot read"):
        read_splat_ply(tmp_path / "absent.ply")


@settings(max_examples=60, deadline=None)
@given(st.binary(max_size=300), st.integers(0, 400))
def test_damage_never_ends_in_anything_but_a_named_error(tmp_path_factory, noise, at):
    path = tmp_path_factory.mktemp("ply") / "x.ply"
    write_splat_ply(path, model(2, 0))
    data = path.read_bytes()
    path.write_bytes(data[:at] + noise + data[at + len(noise) :])
    try:
        assert set(read_splat_ply(path)) == set(model(1, 0))
    except AwError as error:
        assert str(path) in str(error)


def test_wrong_shapes_are_refused_and_leave_no_file(tmp_path):
    for name in model():
        broken = model()
        broken[name] = broken[name][:-1]
        with pytest.raises(AwError, match="cannot write"):
            write_splat_ply(tmp_path / "a.ply", broken)
        del broken[name]
        with pytest.raises(AwError, match=f"no {name}"):
            write_splat_ply(tmp_path / "a.ply", broken)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("kind", "white"), [("<u2", 65535), ("<f4", 1.0), ("<f4", 255.0), ("u1", 255)])
def test_colours_are_read_by_their_range_and_comments_are_no_header(tmp_path, kind, white):
    names = {"<u2": "ushort", "<f4": "float", "u1": "uchar"}
    head = ["ply", "format binary_little_endian 1.0", "comment opacity 1 before the end_header"]
    head += ["element vertex 3", *(f"property float {a}" for a in "xyz")]
    head += [*(f"property {names[kind]} {c}" for c in ("red", "green", "blue")), "end_header\n"]
    table = np.zeros(3, [(a, "<f4") for a in "xyz"] + [(c, kind) for c in "rgb"])
    table["r"], table["g"], table["b"] = [0, white, 0], [white, 0, 0], white * np.array([1, 3, 2]) / 3
    (tmp_path / "a.ply").write_bytes("\n".join(head).encode() + table.tobytes())
    assert not has_splats(tmp_path / "a.ply")
    assert read_point_ply(tmp_path / "a.ply")[1].tolist() == [[0, 255, 85], [255, 0, 255], [0, 0, 170]]


@pytest.mark.parametrize(
    ("kind", "value", "message"),
    [
        ("uint", 7, "x is uint32, not float"),
        ("float", 3e38, "above 1e\\+18"),
        ("double", np.nan, "not finite"),
    ],
)
def test_positions_that_float32_cannot_square_or_that_are_no_floats_are_refused(
    tmp_path, kind, value, message
):
    form = {"uint": "<u4", "float": "<f4", "double": "<f8"}[kind]
    head = ["ply", "format binary_little_endian 1.0", "element vertex 5"]
    head += [*(f"property {kind} {a}" for a in "xyz"), "end_header\n"]
    rows = np.ones((5, 3), form)
    rows[3, 0] = value
    (tmp_path / "a.ply").write_bytes("\n".join(head).encode() + rows.tobytes())
    with pytest.raises(AwError, match=message):
        read_point_ply(tmp_path / "a.ply")


def test_the_filter_of_mip_splattings_own_files_is_fused(tmp_path):
    """Their scale is sqrt(s^2 + f^2), their opacity times sqrt(prod s^2 / prod (s^2 + f^2))."""
    zero = np.zeros((3, 3), np.float32)
    arrays = dict.fromkeys(("means", "sh0"), zero) | {
        "quats": np.tile(np.float32([1, 0, 0, 0]), (3, 1)), "log_scales": zero + np.float32(np.log(0.1)),
        "opacity_logits": zero[:, 0], "sh_rest": np.zeros((3, 0, 3), np.float32),
    }  # fmt: skip
    write_splat_ply(tmp_path / "m.ply", arrays)
    head, _, body = (tmp_path / "m.ply").read_bytes().partition(b"end_header\n")
    rows = np.frombuffer(body, "<f4").reshape(3, -1)
    sizes = np.array([0.0, 0.1, 0.2], "<f4")
    data = np.column_stack([rows, sizes]).astype("<f4").tobytes()
    (tmp_path / "m.ply").write_bytes(head + b"property float filter_3D\nend_header\n" + data)
    found = read_splat_ply(tmp_path / "m.ply")
    assert np.exp(found["log_scales"][:, 0]) == pytest.approx(np.hypot(0.1, sizes))
    opacity = 1 / (1 + np.exp(-found["opacity_logits"]))
    assert opacity == pytest.approx(0.5 * (0.1 / np.hypot(0.1, sizes)) ** 3, rel=1e-5)


def test_a_cloud_without_colours_says_so_and_splats_give_theirs(tmp_path):
    (tmp_path / "c.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
        "end_header\n1 2 3\n"
    )
    with pytest.warns(UserWarning, match="has no colours: its points are grey"):
        assert read_point_ply(tmp_path / "c.ply")[1].tolist() == [[128] * 3]


def test_the_vertical_axis_of_a_header_is_told(tmp_path):
    head = "ply\nformat ascii 1.0\ncomment Vertical Axis: {}\nelement vertex 0\nend_header\n"
    for axis, told in (("z", "z"), ("y", ""), ("X", "x")):
        (tmp_path / "m.ply").write_text(head.format(axis))
        assert stated_up(tmp_path / "m.ply") == told
