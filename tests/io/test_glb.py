from __future__ import annotations

import json
import struct
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from compressed_scenes import arrays_of
from numpy.typing import NDArray
from viewer_scenes import angles, plain_scene, sigmoid

from nsvq_lightning.io import FormatError, glb, read_scene, save

NAME = "KHR_gaussian_splatting"
# By the text of the extension: coefficients of degree l, in the order m = -l...l, turn half around z by (-1)^m.
SIGNS = [-1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1]


def parts(path: Path) -> tuple[dict[str, Any], bytes]:
    data = path.read_bytes()
    magic, version, total, length, kind = struct.unpack_from("<4sIII4s", data)
    assert (magic, version, total, kind, length % 4) == (b"glTF", 2, len(data), b"JSON", 0)
    size, kind = struct.unpack_from("<I4s", data, 20 + length)
    assert (kind, size) == (b"BIN\0", len(data) - 28 - length)
    return json.loads(data[20 : 20 + length]), data[28 + length :]


def attribute(document: dict[str, Any], data: bytes, name: str) -> NDArray[np.float32]:
    accessor = document["accessors"][document["meshes"][0]["primitives"][0]["attributes"][name]]
    view, width = document["bufferViews"][accessor["bufferView"]], {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
    dtype = {5126: "<f4", 5121: "u1"}[accessor["componentType"]]
    return np.frombuffer(data, dtype, width * accessor["count"], view["byteOffset"]).reshape(-1, width)


def write(path: Path, document: dict[str, Any], data: bytes) -> Path:
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
    return path


@pytest.mark.parametrize("degree", range(4))
def test_it_holds_what_the_extension_says(tmp_path: Path, degree: int) -> None:
    """Oracle: the text of the extension."""
    scene = plain_scene(50, degree)
    plain = arrays_of(scene)
    save(scene, tmp_path / "x.glb")
    document, data = parts(tmp_path / "x.glb")
    primitive = document["meshes"][0]["primitives"][0]
    assert primitive["mode"] == 0
    assert primitive["extensions"][NAME]["kernel"] == "ellipse"
    assert primitive["extensions"][NAME]["colorSpace"] == "srgb_rec709_display"
    assert len(primitive["attributes"]) == 5 + (degree + 1) ** 2
    means = attribute(document, data, "POSITION")
    np.testing.assert_array_equal(means, plain.means * np.float32([-1, -1, 1]))
    assert document["accessors"][0]["max"] == pytest.approx(means.max(0).tolist())
    np.testing.assert_allclose(attribute(document, data, f"{NAME}:SCALE"), np.exp(plain.scales), rtol=1e-6)
    opacities = attribute(document, data, f"{NAME}:OPACITY")[:, 0]
    np.testing.assert_allclose(opacities, sigmoid(plain.opacities), atol=1e-7)
    np.testing.assert_array_equal(attribute(document, data, f"{NAME}:SH_DEGREE_0_COEF_0"), plain.sh0[:, 0])
    names = [f"{NAME}:SH_DEGREE_{band}_COEF_{n}" for band in range(1, degree + 1) for n in range(2 * band + 1)]
    for number, name in enumerate(names):
        expected = SIGNS[number] * plain.shN[:, number]
        np.testing.assert_allclose(attribute(document, data, name), expected, atol=1e-6)


def test_a_scene_on_a_map_is_there_to_a_millimetre(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    origin = (4.1e6 + 1 / 1024, -6.3e5, 120.25)
    scene = replace(plain_scene(50, 1), origin=origin)
    save(scene, tmp_path / "x.glb")
    assert not caplog.text
    document, _ = parts(tmp_path / "x.glb")
    assert document["nodes"] == [{"mesh": 0, "translation": [-origin[0], -origin[1], origin[2]]}]
    again = read_scene(tmp_path / "x.glb")
    assert again.origin == origin
    np.testing.assert_array_equal(again.means, scene.means)


def test_covariances_are_turned_half_around_z(tmp_path: Path) -> None:
    """Oracle: R diag(s²) Rᵀ by scipy."""
    from scipy.spatial.transform import Rotation

    scene = plain_scene(50, 0)
    save(scene, tmp_path / "x.glb")
    document, data = parts(tmp_path / "x.glb")

    def covariances(quats: NDArray[Any], scales: NDArray[Any]) -> NDArray[np.float64]:
        axes = Rotation.from_quat(quats).as_matrix() * scales[:, None, :].astype(np.float64)
        return axes @ axes.transpose(0, 2, 1)

    theirs = (attribute(document, data, f"{NAME}:{name}") for name in ("ROTATION", "SCALE"))
    plain, turn = arrays_of(scene), np.diag([-1.0, -1, 1])
    expected = turn @ covariances(plain.quats[:, [1, 2, 3, 0]], np.exp(plain.scales)) @ turn
    np.testing.assert_allclose(covariances(*theirs), expected, rtol=1e-4, atol=1e-5)


def test_nodes_put_splats_in_their_place_and_small_numbers_are_read(tmp_path: Path) -> None:
    scene = plain_scene(20, 1)
    save(scene, tmp_path / "x.glb")
    document, data = parts(tmp_path / "x.glb")
    document["nodes"] = [
        {"children": [1, 2], "translation": [1, 2, 3]},
        {"mesh": 0, "scale": [2, 2, 2]},
        {"mesh": 0, "matrix": [0, 1, 0, 0, -1, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]},
    ]
    names = document["meshes"][0]["primitives"][0]["attributes"]
    opacity = np.rint(255 * attribute(document, data, f"{NAME}:OPACITY")).astype(np.uint8)
    rotation = np.rint(32767 * attribute(document, data, f"{NAME}:ROTATION")).astype("<i2")
    for name, values, kind in ((f"{NAME}:OPACITY", opacity, 5121), (f"{NAME}:ROTATION", rotation, 5122)):
        view = document["bufferViews"][document["accessors"][names[name]]["bufferView"]]
        view["byteOffset"], view["byteLength"] = len(data), values.nbytes
        document["accessors"][names[name]] |= {"componentType": kind, "normalized": True}
        data += values.tobytes()
    document["buffers"][0]["byteLength"] = len(data)
    back, plain = read_scene(write(tmp_path / "y.glb", document, data)), arrays_of(scene)
    x, y, z = (plain.means * [-1, -1, 1]).T
    doubled, turned = np.stack([2 * x, 2 * y, 2 * z], 1), np.stack([-y, x, z], 1)
    expected = np.concatenate([doubled, turned]) + np.array([1, 2, 3])
    np.testing.assert_allclose(back.means * [-1, -1, 1], expected, atol=1e-5)
    np.testing.assert_allclose(back.values("scales")[:20], plain.scales + np.log(2), atol=1e-5)
    assert np.degrees(angles(back.values("quats")[:20], plain.quats)).max() < 0.01
    assert np.abs(sigmoid(back.opacities)[:20] - sigmoid(plain.opacities)).max() < 0.5 / 255 + 1e-6


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d["meshes"][0]["primitives"][0].pop("extensions"), "no primitive has the extension"),
        (lambda d: d["nodes"][0].update(scale=[1, 2, 1]), "turned and scaled evenly only"),
        (lambda d: d["nodes"][0].update(children=[0]), "a node is in two others"),
        (lambda d: d["accessors"][2].update(sparse={}), "sparse accessors or in other files are not read"),
        (lambda d: d["accessors"][2].update(count=1 << 40), "accessor 2 ends beyond the file"),
        (lambda d: d["meshes"][0]["primitives"][0]["extensions"][NAME].update(extensions={"spz": {}}), "compressed by"),
        (lambda d: d["scenes"][0].update(nodes=[0] * 9000), "a node is in two others"),
        (
            lambda d: d["bufferViews"][3].update(extensions={"EXT_meshopt_compression": {}}),
            "by EXT_meshopt_compression",
        ),
        (
            lambda d: d["meshes"][0]["primitives"][0]["attributes"].pop(f"{NAME}:SH_DEGREE_1_COEF_2"),
            f"without the attribute {NAME}:SH_DEGREE_1_COEF_2",
        ),
        (
            lambda d: d["meshes"][0]["primitives"][0]["attributes"].pop(f"{NAME}:SCALE"),
            f"without the attribute {NAME}:SCALE",
        ),
    ],
)
def test_what_is_not_read_is_said(tmp_path: Path, change: Any, message: str) -> None:
    save(plain_scene(20, 1), tmp_path / "x.glb")
    document, data = parts(tmp_path / "x.glb")
    change(document)
    with pytest.raises(FormatError, match=message) as caught:
        read_scene(write(tmp_path / "y.glb", document, data))
    assert ("copy the file again" in str(caught.value)) == ("ends beyond the file" in message)


def renamed(document: dict[str, Any], **names: str) -> dict[str, int]:
    """The attributes of the primitive, some under other names."""
    primitive = document["meshes"][0]["primitives"][0]
    old = primitive["attributes"]
    primitive["attributes"] = {names.get(name.split(":")[-1], name): number for name, number in old.items()}
    return primitive["attributes"]


def replaced(document: dict[str, Any], data: bytes, name: str, values: NDArray[Any], **accessor: Any) -> bytes:
    """The numbers of the file, with others for an attribute."""
    number = document["meshes"][0]["primitives"][0]["attributes"][name]
    view = document["bufferViews"][document["accessors"][number]["bufferView"]]
    document["accessors"][number] |= accessor
    view["byteOffset"], view["byteLength"] = len(data), values.nbytes
    document["buffers"][0]["byteLength"] = len(data) + values.nbytes
    return data + values.tobytes()


def test_lengths_that_are_logarithms_are_known_by_their_sign(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    scene = plain_scene(20, 0)
    scene.values("scales")[:] += 9  # in centimetres few logarithms are below 0
    scene.values("scales")[5, 1] = -0.5
    save(scene, tmp_path / "x.glb")
    document, data = parts(tmp_path / "x.glb")
    logs = scene.values("scales").copy()
    logs[3, 2] = -np.inf
    data = replaced(document, data, f"{NAME}:OPACITY", scene.opacities)
    back = read_scene(write(tmp_path / "y.glb", document, replaced(document, data, f"{NAME}:SCALE", logs)))
    logs[3, 2] = -20.0
    np.testing.assert_allclose(back.values("scales"), logs, rtol=1e-6)
    assert "taken as logarithms" in caplog.text
    np.testing.assert_array_equal(back.opacities, scene.opacities)
    assert "taken as logits" in caplog.text


def test_names_of_drafts_are_known(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    save(plain_scene(20, 1), tmp_path / "x.glb")
    document, data = parts(tmp_path / "x.glb")
    draft = {
        "ROTATION": "_ROTATION",
        "SCALE": "_SCALE",
        "OPACITY": "_OPACITY",
        "SH_DEGREE_1_COEF_0": "_SH_DEGREE_1_COEF_0",
    }
    renamed(document, **draft)
    whole, back = (
        arrays_of(read_scene(path)) for path in (tmp_path / "x.glb", write(tmp_path / "y.glb", document, data))
    )
    for name, values in vars(whole).items():
        np.testing.assert_array_equal(getattr(back, name), values, err_msg=name)
    assert "draft" in caplog.text


def test_drafts_had_colours_and_opacities_in_those_of_the_points(tmp_path: Path) -> None:
    save(plain_scene(20, 0), tmp_path / "x.glb")
    document, data = parts(tmp_path / "x.glb")
    names = renamed(document, ROTATION="_ROTATION", SCALE="_SCALE")
    del names[f"{NAME}:OPACITY"], names[f"{NAME}:SH_DEGREE_0_COEF_0"]
    colors = np.random.default_rng(1).integers(1, 255, (20, 4), np.uint8)
    back = read_scene(write(tmp_path / "y.glb", document, replaced(document, data, "COLOR_0", colors)))
    np.testing.assert_allclose(0.5 + 0.28209479 * back.values("sh0")[:, 0], colors[:, :3] / 255, atol=1e-6)
    np.testing.assert_allclose(sigmoid(back.opacities), colors[:, 3] / 255, atol=1e-6)
    view = document["accessors"][names["COLOR_0"]]["bufferView"]
    document["bufferViews"][view]["byteStride"] = 4
    opaque = read_scene(write(tmp_path / "z.glb", document, replaced(document, data, "COLOR_0", colors, type="VEC3")))
    np.testing.assert_array_equal(opaque.values("sh0"), back.values("sh0"))
    assert (sigmoid(opaque.opacities) > 0.999).all()


@pytest.mark.parametrize(("normalized", "unit"), [(True, 127), (False, 1)])
def test_whole_numbers_are_fractions_only_where_that_is_said(tmp_path: Path, normalized: bool, unit: int) -> None:
    save(plain_scene(20, 0), tmp_path / "x.glb")
    document, data = parts(tmp_path / "x.glb")
    lengths = np.random.default_rng(1).integers(1, 127, (20, 3)).astype(np.int8)
    data = replaced(document, data, f"{NAME}:SCALE", lengths, componentType=5120, normalized=normalized)
    back = read_scene(write(tmp_path / "y.glb", document, data))
    np.testing.assert_allclose(np.exp(back.values("scales")), lengths / unit, rtol=1e-5)


def test_a_primitive_with_indices_is_those_points(tmp_path: Path) -> None:
    save(plain_scene(20, 1), tmp_path / "x.glb")
    document, data = parts(tmp_path / "x.glb")
    indices = np.array([7, 3, 3, 19], "<u4")
    document["meshes"][0]["primitives"][0]["indices"] = len(document["accessors"])
    document["accessors"].append(
        {"bufferView": len(document["bufferViews"]), "count": 4, "type": "SCALAR", "componentType": 5125}
    )
    document["bufferViews"].append({"buffer": 0, "byteOffset": len(data), "byteLength": 16})
    document["buffers"][0]["byteLength"] = len(data) + 16
    back, whole = (
        read_scene(write(tmp_path / "y.glb", document, data + indices.tobytes())),
        read_scene(tmp_path / "x.glb"),
    )
    for name in ("means", "quats", "scales", "opacities", "sh0", "shN"):
        np.testing.assert_array_equal(back.values(name), whole.values(name)[indices], err_msg=name)
    beyond = data + np.array([7, 3, 3, 20], "<u4").tobytes()
    with pytest.raises(FormatError, match="index 20 is out of bounds"):
        read_scene(write(tmp_path / "y.glb", document, beyond))


def test_linear_light_is_said(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    save(plain_scene(20, 0), tmp_path / "x.glb")
    document, data = parts(tmp_path / "x.glb")
    about = document["meshes"][0]["primitives"][0]["extensions"][NAME]
    about |= {"colorSpace": "lin_rec709_display", "kernel": "beta"}
    read_scene(write(tmp_path / "y.glb", document, data))
    assert "splats of the kernel beta are shown as of ellipse" in caplog.text
    assert "lin_rec709_display: colours are linear light" in caplog.text


def test_instances_of_a_node_are_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    save(plain_scene(20, 1), tmp_path / "x.glb")
    document, data = parts(tmp_path / "x.glb")
    document["nodes"][0]["extensions"] = {"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": 0}}}
    assert len(read_scene(write(tmp_path / "y.glb", document, data))) == 20
    assert "a node has EXT_mesh_gpu_instancing, which is not read" in caplog.text


def test_more_than_lengths_of_32_bits_can_say_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(glb, "_HEAD", SimpleNamespace(size=2**32 - 100))  # as of 18 million splats of degree 3
    with pytest.raises(ValueError, match=r"scene\.glb: 429\d{7} bytes are more than a \.glb can have: write \.ply"):
        save(plain_scene(5), tmp_path / "scene.glb")
    assert not list(tmp_path.iterdir())
