from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from compressed_scenes import arrays_of, scene_of

from nsvq_lightning.io import CompressedScene, FormatError, read_ply, read_scene, save, write_ply
from nsvq_lightning.io.ply import plain_ply_bytes
from nsvq_lightning.splats.attributes import ATTRIBUTES, attribute_shapes


def scene(n: int, degree: int = 3) -> CompressedScene:
    rng = np.random.default_rng([n, degree])
    shapes = attribute_shapes(degree).items()
    return scene_of(**{name: rng.standard_normal((n, *shape), np.float32) for name, shape in shapes})


def assert_same(a: CompressedScene, b: CompressedScene) -> None:
    for name in ATTRIBUTES:
        np.testing.assert_array_equal(a.values(name), b.values(name), err_msg=name)


def _names(degree: int) -> list[str]:
    rest = 3 * ((degree + 1) ** 2 - 1)
    return [
        *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"),
        *(f"f_rest_{i}" for i in range(rest)),
        *("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
    ]


def _values(scene: CompressedScene, row: int) -> dict[str, float]:
    """Oracle: what each property of one splat must be, number by number from the description of the layout."""
    splats = arrays_of(scene)
    coefficients = splats.shN.shape[1]
    rest = {f"f_rest_{c * coefficients + k}": splats.shN[row, k, c] for c in range(3) for k in range(coefficients)}
    values = {
        **dict(zip("xyz", splats.means[row], strict=True)),
        **dict.fromkeys(("nx", "ny", "nz"), 0.0),
        **{f"f_dc_{c}": splats.sh0[row, 0, c] for c in range(3)},
        **rest,
        "opacity": splats.opacities[row],
        **{f"scale_{i}": splats.scales[row, i] for i in range(3)},
        **{f"rot_{i}": splats.quats[row, i] for i in range(4)},
    }
    return {name: float(value) for name, value in values.items()}


def _header(properties: list[str], count: int, encoding: str = "binary_little_endian", before: str = "") -> bytes:
    body = "".join(f"property {line}\n" for line in properties)
    return f"ply\nformat {encoding} 1.0\n{before}element vertex {count}\n{body}end_header\n".encode()


@pytest.mark.parametrize("degree", range(4))
def test_written_bytes_are_the_layout_of_the_authors(tmp_path: Path, degree: int) -> None:
    splats, path = scene(5, degree), tmp_path / "x.ply"
    names = _names(degree)
    rows = [struct.pack(f"<{len(names)}f", *(_values(splats, row)[name] for name in names)) for row in range(5)]
    expected = _header([f"float {name}" for name in names], 5) + b"".join(rows)
    assert write_ply(path, splats) == len(expected) == plain_ply_bytes(5, degree)
    assert path.read_bytes() == expected
    assert_same(read_ply(path), splats)


def test_any_order_type_and_byte_order_and_further_properties_and_elements(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    splats, path = scene(6, 1), tmp_path / "x.ply"
    names = sorted(_names(1), reverse=True)
    kinds = ["double" if i % 2 else "float32" for i in range(len(names))]
    properties = ["uchar red", *(f"{kind} {name}" for kind, name in zip(kinds, names, strict=True)), "short label"]
    code = "".join("d" if kind == "double" else "f" for kind in kinds)
    for encoding, order in (("binary_little_endian", "<"), ("binary_big_endian", ">")):
        rows = [
            struct.pack(f"{order}B{code}h", 255, *(_values(splats, row)[name] for name in names), -7)
            for row in range(6)
        ]
        before = "comment made elsewhere\nelement camera 2\nproperty int id\nproperty uint8 kind\n"
        head = _header(properties, 6, encoding, before).replace(b"\n", b"\r\n")
        path.write_bytes(head + bytes(10) + b"".join(rows) + b"more elements")
        caplog.clear()
        assert_same(read_ply(path), splats)
        assert f"{path}: 1 other properties are left out (label): " in caplog.text


def test_ascii(tmp_path: Path) -> None:
    splats, path = scene(3, 2), tmp_path / "x.ply"
    names = _names(2)
    lines = [" ".join(repr(_values(splats, row)[name]) for name in names) for row in range(3)]
    head = _header([f"float {name}" for name in names], 3, "ascii", "element note 1\nproperty int a\n")
    path.write_bytes(head + ("17\n" + "\n".join(lines)).encode())
    assert_same(read_ply(path), splats)
    path.write_bytes(head + ("17\n" + "\n".join(lines[:2]) + 3000 * " ").encode())
    with pytest.raises(FormatError, match="3 lines"):
        read_ply(path)
    path.write_bytes(head + ("17\n" + "\n".join(lines).replace(".", "x", 1)).encode())
    with pytest.raises(FormatError, match=r"x\.ply: bad ascii data"):
        read_ply(path)


def test_infinite_logits_of_byte_opacities_become_finite(tmp_path: Path) -> None:
    splats, path = scene(3), tmp_path / "x.ply"
    write_ply(path, splats)
    data = bytearray(path.read_bytes())
    column = len(data) - 3 * 62 * 4 + 4 * _names(3).index("opacity")
    data[column : column + 4] = struct.pack("<f", np.inf)
    data[column + 248 : column + 252] = struct.pack("<f", -np.inf)
    path.write_bytes(data)
    np.testing.assert_array_equal(read_ply(path).opacities, np.array([20.0, -20.0, splats.opacities[2]]))


def test_every_truncation_is_one_clear_error(tmp_path: Path) -> None:
    path = tmp_path / "cut.ply"
    write_ply(path, scene(2, 0))
    data = path.read_bytes()
    for length in range(len(data)):
        path.write_bytes(data[:length])
        with pytest.raises(FormatError, match=r"cut\.ply: "):
            read_ply(path)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"ply\n", b"PLY\n", "does not start"),
        (b"vertex 2", b"vertex 2000000000000", "truncated: 2000000000000 vertices"),
        (b"vertex 2", b"vertex -2", "bad header line"),
        (b"vertex 2", b"vertex 1e3", "bad header line"),
        (b"vertex 2", b"points 2", "no element vertex"),
        (b"binary_little_endian", b"binary_middle_endian", "format line"),
        (b"property float opacity\n", b"", "no property opacity"),
        (b"property float opacity", b"property quad opacity", "bad header line"),
        (b"property float opacity", b"property list uchar float opacity", "holds lists"),
        (b"property float nx", b"property float x", "'x' twice"),
        (b"property float f_rest_8\n", b"", "0, 9, 24 or 45"),
        (b"f_rest_0\n", b"f_rest_00\n", r"x\.ply: .*; got 9, among them f_rest_00"),
        (b"f_rest_8\n", b"f_rest_\xb2\n", r"x\.ply: .*; got 9, among them f_rest_"),
        (b"end_header\n", b"end_heather\n", "no end_header"),
    ],
)
def test_garbled_headers(tmp_path: Path, old: bytes, new: bytes, message: str) -> None:
    path = tmp_path / "x.ply"
    write_ply(path, scene(2, 1))
    data = path.read_bytes()
    assert old in data
    path.write_bytes(data.replace(old, new, 1))
    with pytest.raises(FormatError, match=message):
        read_ply(path)


def _packed(**counts: int) -> bytes:
    """Two compressed splats, all of whose bits are 0, with harmonics of degree 1."""
    bounds = [f"{end}_{part}{axis}" for part in ("", "scale_") for end in ("min", "max") for axis in "xyz"]
    elements = [
        ("chunk", 1, [f"float {name}" for name in bounds]),
        ("vertex", 2, [f"uint packed_{name}" for name in ("position", "rotation", "scale", "color")]),
        ("sh", 2, [f"uchar f_rest_{i}" for i in range(9)]),
    ]
    text = "ply\nformat binary_little_endian 1.0\n"
    for name, count, properties in elements:
        text += f"element {name} {counts.get(name, count)}\n" + "".join(f"property {line}\n" for line in properties)
    return text.encode() + b"end_header\n" + struct.pack("<12f", *range(12)) + bytes(2 * 16 + 2 * 9)


def test_a_compressed_ply_is_known_by_its_header(tmp_path: Path) -> None:
    path = tmp_path / "x.ply"
    path.write_bytes(_packed())
    read = arrays_of(read_ply(path))
    np.testing.assert_array_equal(read.means, [[0, 1, 2]] * 2)
    np.testing.assert_array_equal(read.scales, [[6, 7, 8]] * 2)
    np.testing.assert_allclose(read.quats, [[0, *[-(0.5**0.5)] * 3]] * 2, atol=1e-6)  # of no unit length: damaged
    np.testing.assert_array_equal(read.opacities, [-20, -20])
    np.testing.assert_allclose(read.sh0, -np.sqrt(np.pi))
    np.testing.assert_array_equal(read.shN, np.full((2, 3, 3), -4))


@pytest.mark.parametrize("ends", [(6, 9), (6,)])
def test_bounds_of_flat_splats_may_be_infinite(tmp_path: Path, ends: tuple[int, ...]) -> None:
    path, data = tmp_path / "x.ply", bytearray(_packed())
    start = data.index(b"end_header\n") + len(b"end_header\n")
    for number in ends:
        struct.pack_into("<f", data, start + 4 * number, -np.inf)
    path.write_bytes(data)
    scales = read_ply(path).values("scales")
    assert np.isfinite(scales).all()
    assert scales[0, 0] == -20


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (_packed()[:-1], "truncated: 2 vertices need"),
        (_packed(vertex=10**9), "truncated: 1000000000 vertices need"),
        (_packed(sh=10**9), "truncated: 2 vertices need"),
        (_packed(chunk=0), "damaged: 2 compressed splats, 0 chunks of 256, harmonics of 2"),
        (_packed(sh=1), "damaged: 2 compressed splats, 1 chunks of 256, harmonics of 1"),
        (_packed().replace(b"uint packed_scale", b"int packed_scale"), "no property packed_scale of type u4"),
        (_packed().replace(b"min_scale_x", b"min_scale_q"), "no property min_scale_x of type f4"),
        (_packed().replace(b"uchar f_rest_3", b"char f_rest_3"), "no property f_rest_3 of type u1"),
        (_packed().replace(b"f_rest_3", b"f_rest_9"), "got 9, among them f_rest_9"),
        (_packed().replace(b"f_rest_", b"coeff_"), "got 9, among them coeff_0"),
        (_packed().replace(b"binary_little_endian", b"ascii"), "ascii"),
    ],
)
def test_damaged_compressed_ply(tmp_path: Path, data: bytes, message: str) -> None:
    path = tmp_path / "x.ply"
    path.write_bytes(data)
    with pytest.raises(FormatError, match=rf"x\.ply: .*{message}"):
        read_ply(path)


def _changed(path: Path, splats: CompressedScene, *changes: tuple[bytes, bytes], rows: bytes = b"") -> CompressedScene:
    """What is read of the file of splats with another header, and with bytes before its rows."""
    write_ply(path, splats)
    head, end, body = path.read_bytes().partition(b"end_header\n")
    for old, new in changes:
        assert old in head
        head = head.replace(old, new)
    path.write_bytes(head + end + rows + body)
    return read_scene(path)


def _columns(path: Path, columns: dict[str, np.ndarray]) -> CompressedScene:
    """What is read of a file with these columns."""
    names = {"f4": "float", "u1": "uchar", "u2": "ushort", "f2": "half", "f8": "double"}
    rows = np.rec.fromarrays(list(columns.values()), names=list(columns))
    properties = [f"{names[rows.dtype[name].str[1:]]} {name}" for name in columns]
    path.write_bytes(_header(properties, len(rows)) + rows.tobytes())
    return read_scene(path)


def test_names_with_the_prefix_of_a_point_cloud_editor_are_known(tmp_path: Path) -> None:
    splats = scene(4, 1)
    changes = [(b"float " + name, b"float scalar_" + name) for name in (b"f_", b"opacity", b"scale_", b"rot_")]
    assert_same(_changed(tmp_path / "x.ply", splats, *changes), splats)


@pytest.mark.parametrize("encoding", ["binary_little_endian", "ascii"])
def test_doubles_on_a_map_keep_their_detail(tmp_path: Path, encoding: str) -> None:
    """As CloudCompare writes them where it has shifted a scene."""
    splats = scene(60, 0)
    place = np.array([5e5, 4.1e6, 120.0])
    names = _names(0)
    values = np.array([[*_values(splats, row).values()] for row in range(60)])
    values[:, :3] += place
    kinds = ["double" if name in "xyz" else "float" for name in names]
    rows = np.rec.fromarrays([*values.T], ",".join("<f8" if kind == "double" else "<f4" for kind in kinds))
    lines = "\n".join(" ".join(map(repr, row)) for row in values.tolist())
    head = _header([f"{kind} {name}" for kind, name in zip(kinds, names, strict=True)], 60, encoding)
    (tmp_path / "x.ply").write_bytes(head + (rows.tobytes() if encoding != "ascii" else lines.encode()))
    read = read_ply(tmp_path / "x.ply")
    np.testing.assert_allclose(read.means.astype(float) + read.origin, splats.means + place, rtol=0, atol=1e-6)
    assert np.abs(read.means).max() < 10


def test_z_that_is_up_is_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    for axis in "yz":
        _changed(tmp_path / "x.ply", scene(4, 0), (b"element", b"comment Vertical Axis: %s\nelement" % axis.encode()))
        assert ("--up minus-y --up-from 0 0 1" in caplog.text) == (axis == "z")


def test_discs_are_read_with_next_to_no_thickness(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    splats = scene(5, 0)
    columns = {name: np.array([_values(splats, row)[name] for row in range(5)], "<f4") for name in _names(0)}
    thin = np.full(5, -20.0)
    flat = _columns(tmp_path / "x.ply", columns | {"scale_2": np.full(5, -np.inf, "<f4")})
    np.testing.assert_allclose(flat.values("scales"), np.c_[splats.values("scales")[:, :2], thin], rtol=1e-6)
    assert_same(_columns(tmp_path / "y.ply", {name: columns[name] for name in columns if name != "scale_2"}), flat)
    assert not caplog.text
    odd = columns | {"scale_0": np.array([0, np.inf, np.nan, 0, -np.inf], "<f4")}
    assert len(_columns(tmp_path / "z.ply", odd)) == 3
    assert "dropped 2 of 5 splats with non-finite values: scales in 2 rows" in caplog.text


def test_the_filter_of_mip_splatting_becomes_part_of_the_splats(tmp_path: Path) -> None:
    splats = scene(5)
    widths = np.array([0, 1e-3, 0.1, 1, 100], np.float32)
    columns = [_values(splats, row) | {"filter_3D": float(widths[row])} for row in range(5)]
    table = {name: np.array([row[name] for row in columns], np.float32) for name in columns[0]}
    found = _columns(tmp_path / "a.ply", table)
    sizes = np.exp(splats.rows("scales").astype(float))
    wider = np.sqrt(sizes**2 + widths[:, None] ** 2)
    assert np.allclose(np.exp(found.rows("scales")), wider, rtol=1e-5)
    opacities = 1 / (1 + np.exp(-splats.opacities.astype(float)))
    expected = opacities * (sizes / wider).prod(1)
    assert np.allclose(1 / (1 + np.exp(-found.opacities.astype(float))), expected, rtol=1e-4)
    assert found.antialiased  # it was trained with a filter of the pixels, too
    assert not splats.antialiased


def test_harmonics_of_0_in_a_compressed_file_brighten_nothing(tmp_path: Path) -> None:
    splats = scene(300)
    for value in (0.0, 0.5, -1 / 32):
        splats.raw["shN"][:] = value
        save(splats, tmp_path / "a.compressed.ply")
        error = arrays_of(read_scene(tmp_path / "a.compressed.ply")).shN - value
        assert abs(error).max() <= 1 / 64 + 1e-6
        assert abs(error.mean((1, 2))).max() < 1 / 64 / 40  # of every splat
        assert abs(error.mean(0)).max() < 1e-6  # of every coefficient


def test_harmonics_beyond_what_a_compressed_file_holds_are_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    splats = scene(5)
    splats.raw["shN"][:] = np.linspace(-3.9, 3.9, 225).reshape(5, 45)
    save(splats, tmp_path / "a.compressed.ply")
    assert not caplog.text
    splats.raw["shN"][2:4, 7] = 4.1, -19
    save(splats, tmp_path / "a.compressed.ply")
    assert "clamped to it: shN 2 (of 5 splats)" in caplog.text


@pytest.mark.parametrize(("kind", "full"), [("u1", 255), ("u2", 65535), ("u2", 255), ("f4", 1), ("f4", 255), ("f8", 1)])
def test_colours_stand_in_for_coefficients(tmp_path: Path, kind: str, full: int) -> None:
    """Oracle: colour = 0.5 + f_dc / (2 √π)."""
    splats, colors = scene(4, 0), np.array([[0, 0.2, 1], [0.4, 1, 0.6], [1, 0, 0], [0.8, 0.2, 0]])
    columns = {name: np.array([_values(splats, row)[name] for row in range(4)], "<f4") for name in _names(0)}
    for name in ("f_dc_0", "f_dc_1", "f_dc_2"):
        del columns[name]
    columns |= dict(zip(("red", "green", "blue"), (full * colors).astype(kind).T, strict=True))
    read = _columns(tmp_path / "x.ply", columns)
    np.testing.assert_allclose(0.5 + read.values("sh0")[:, 0] / np.sqrt(4 * np.pi), colors, atol=1e-6)


@pytest.mark.parametrize("strange", [np.nan, np.inf, -np.inf])
def test_one_strange_colour_changes_no_other(tmp_path: Path, strange: float) -> None:
    splats = scene(4, 0)
    columns = {name: np.array([_values(splats, row)[name] for row in range(4)], "<f4") for name in _names(0)}
    for name in ("f_dc_0", "f_dc_1", "f_dc_2"):
        del columns[name]
    columns |= {name: np.array([0.9, 0.9, strange, 0.9], "<f4") for name in ("red", "green", "blue")}
    read = _columns(tmp_path / "x.ply", columns)
    np.testing.assert_allclose(0.5 + read.values("sh0")[[0, 1, -1], 0] / np.sqrt(4 * np.pi), 0.9, atol=1e-6)


def test_half_precision(tmp_path: Path) -> None:
    splats = scene(4, 0)
    columns = {name: np.array([_values(splats, row)[name] for row in range(4)], "<f2") for name in _names(0)}
    read = _columns(tmp_path / "x.ply", columns)
    for name in ATTRIBUTES:
        np.testing.assert_array_equal(read.values(name), splats.values(name).astype(np.float16))


def test_lists_before_and_after_the_vertices_are_passed_over(tmp_path: Path) -> None:
    splats, path = scene(3, 0), tmp_path / "x.ply"
    faces = b"element face %d\nproperty uchar kind\nproperty list uchar int corners\nelement vertex"
    after = (b"property float rot_3\n", b"property float rot_3\nelement edge 0\nproperty list int float ends\n")
    assert_same(_changed(path, splats, (b"element vertex", faces % 0), after), splats)
    rows = struct.pack("<BBiiiBB", 7, 3, 0, 1, 2, 7, 0)
    assert_same(_changed(path, splats, (b"element vertex", faces % 2), rows=rows), splats)
    names = _names(0)
    lines = [" ".join(repr(_values(splats, row)[name]) for name in names) for row in range(3)]
    head = _header([f"float {name}" for name in names], 3, "ascii", (faces % 2).decode().removesuffix("element vertex"))
    path.write_bytes(head + "\n".join(["7 3 0 1 2", "7 0", *lines]).encode())
    assert_same(read_ply(path), splats)
    for length in (b"\xff", b""):
        with pytest.raises(FormatError, match=r"x\.ply: truncated"):
            _changed(path, splats, (b"vertex 3", b"vertex 0"), (b"element vertex", faces % 2), rows=b"\7" + length)


def test_a_header_may_be_long(tmp_path: Path) -> None:
    splats, comments = scene(2, 0), b"".join(b"comment camera %d\n" % number for number in range(70_000))
    assert len(comments) > 1 << 20
    assert_same(_changed(tmp_path / "x.ply", splats, (b"element vertex", comments + b"element vertex")), splats)


def test_only_damaged_files_are_to_be_copied_again(tmp_path: Path) -> None:
    path = tmp_path / "x.ply"
    for content, again in ((b"pl", True), (b"ply\nformat", True), (b"solid x", False), (_header(["int x"], 0), False)):
        path.write_bytes(content)
        with pytest.raises(FormatError) as caught:
            read_scene(path)
        assert ("copy the file again" in str(caught.value)) == again, content
