"""Point clouds to start from: ``.ply`` files of any program, with colours of any kind."""

import re
from pathlib import Path

import numpy as np

from nsvq_lightning.data.colmap import SceneError, rgb_bytes
from nsvq_lightning.io.errors import FormatError
from nsvq_lightning.io.ply import PlyHeader, read_ply_columns, read_ply_header
from nsvq_lightning.splats.conventions import SH_C0, Float64s, Uint8s


def read_points(path: Path) -> tuple[Float64s, Uint8s]:
    """Positions ``[P, 3]`` and RGB colours ``[P, 3]`` of a ``.ply`` point cloud; points without a colour are grey.

    Raises:
        SceneError: There is no such file, or it is damaged or no point cloud.
    """
    if not path.is_file():
        raise SceneError(f"points {path} do not exist: copy the file, or remove ply_file_path from the transforms file")
    try:
        header = read_ply_header(path)
        known = _properties(header)
        if missing := [axis for axis in "xyz" if axis not in known]:
            raise FormatError(f"{path}: its vertices have no {', '.join(missing)}")
        rgb = next((names for names in _COLORS if known.keys() >= {*names}), ())
        names = [known[name] for name in (*"xyz", *rgb)]
        parts = list(read_ply_columns(path, header, names, np.float64))
    except FormatError as error:
        raise SceneError(f"points {error}") from error
    table = np.concatenate([np.zeros((0, len(names))), *parts])
    xyz, values = table[:, :3], table[:, 3:]
    if not rgb:
        return xyz, np.full((len(xyz), 3), 128, np.uint8)
    if rgb == _COLORS[2]:
        values = (0.5 + SH_C0 * values).clip(0, 1)
    return xyz, rgb_bytes(values, floats=header.dtype[names[3]].kind == "f")


# Names of three properties that are a colour, in the order in which they are looked for: those of splats come third.
_COLORS = (("red", "green", "blue"), ("r", "g", "b"), ("f_dc_0", "f_dc_1", "f_dc_2"), ("intensity",) * 3)


def _properties(header: PlyHeader) -> dict[str, str]:
    """The properties by their name in lower case, without what some programs put before it."""
    bare = {re.sub("^(scalar|diffuse|vertex)_", "", name.lower()): name for name in header.properties}
    return bare | {name.lower(): name for name in header.properties}


# Point clouds of other programs, in the folder that their cameras are in.
_CLOUDS = ("points3d", "sparse_pc", "sparse_pcd", "point_cloud", "pointcloud", "points")


def cloud_in(folders: list[Path]) -> Path | None:
    """The ``.ply`` file of points in the first of some folders that has one: with a usual name, or the only one.

    Raises:
        SceneError: There are several.
    """
    for folder in folders:
        files = sorted(path for path in folder.glob("*") if path.suffix.lower() == ".ply")
        usual = [path for path in files if path.stem.lower() in _CLOUDS] or files
        if len(usual) > 1:
            raise SceneError(f"{usual[0]} and {usual[1]} may be the points to start from: leave one of them there")
        if usual:
            return usual[0]
    return None
