from __future__ import annotations

import gc
import logging
import os
import signal
import subprocess
import sys

# Before torch loads OpenMP: threads that wait by spinning slow everything down where cores are shared.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

from collections.abc import Callable, Iterator
from importlib.abc import MetaPathFinder
from pathlib import Path

import cv2
import numpy as np
import pytest
from guards import guarded
from small_demo import write_small_demo

from nsvq_lightning.data.colmap import import_pycolmap

pytest_plugins = ["run_fixtures"]

FIRST = ("test_triton.py", "test_fit.py", "test_interruption.py", "test_view_parallel.py", "test_kernel_entries.py")
"""Files that take longest: one that starts last would be waited for."""


def pytest_addoption(parser: pytest.Parser) -> None:
    """The option of ``test_stress.py``."""
    parser.addoption("--stress-table", metavar="PATH", help="where test_stress.py writes what extreme scenes do")


def pytest_sessionstart(session: pytest.Session) -> None:
    """Compile the kernels that many tests need before test processes start, which would wait for one another."""
    if hasattr(session.config, "workerinput") or not getattr(session.config.option, "numprocesses", None):
        return
    command = [sys.executable, "-m", "nsvq_lightning.compute.ahead"]
    if any(process.wait() for process in [subprocess.Popen(command) for _ in range(2)]):
        raise pytest.UsageError(f"{' '.join(command)} failed, see above")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the files first that take longest; of what was imported, which takes 0.3 s each time, collect no garbage."""
    items.sort(key=lambda item: FIRST.index(item.path.name) if item.path.name in FIRST else len(FIRST))
    gc.freeze()


class SkipWithoutPycolmap(MetaPathFinder):
    """Skips whatever test imports pycolmap where there is none; asked last, when no other finder knows the module."""

    def find_spec(self, name: str, path: object, target: object = None) -> None:
        if name == "pycolmap":
            pytest.skip("pycolmap is not installed (it has no wheel for Linux on ARM64)")


sys.meta_path.append(SkipWithoutPycolmap())

SceneFactory = Callable[..., Path]


@pytest.fixture(scope="session", autouse=True)
def ctrl_c() -> None:
    """A shell starts what it puts into the background (``pytest &``) with SIGINT ignored; tests of Ctrl-C need it."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(autouse=True)
def log_level() -> Iterator[None]:
    """A command sets the level of the package's log for its process; tests after it want their own."""
    log = logging.getLogger("nsvq_lightning")
    level = log.level
    yield
    log.setLevel(level)


WHOLE_RUNS = {"benchmark", "commands", "compression", "training", "runs"}
"""Folders whose tests train: ``properties/runs/test_skips.py`` does so for all of them between guard words."""


@pytest.fixture(autouse=True)
def guard_words(request: pytest.FixtureRequest) -> Iterator[None]:
    """In tests of kernels and what calls them, kernels work between guard words, but for the mark ``unguarded``."""
    if request.path.parent.name in WHOLE_RUNS or request.node.get_closest_marker("unguarded"):
        yield
        return
    with guarded():
        yield


@pytest.fixture(scope="session")
def shared_scenes() -> Path:
    """Folder of the real captures."""
    folder = Path(__file__).resolve().parents[2] / "shared" / "scenes"
    if not folder.is_dir():
        pytest.skip(f"the real captures are not here ({folder} is missing)")
    return folder


@pytest.fixture(scope="session")
def demo_scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small scene of 9 views, 96x72, written once; read-only."""
    return write_small_demo(tmp_path_factory.mktemp("demo") / "scene", views=9, width=96, height=72, points=500)


@pytest.fixture
def make_scene(tmp_path: Path) -> SceneFactory:
    """Writes a COLMAP scene of noise pictures; keyword arguments say what is in it."""

    def make(
        name: str = "scene",
        views: int = 9,
        model: str = "PINHOLE",
        params: tuple[float, ...] = (30.0, 31.0, 21.0, 15.0),
        size: tuple[int, int] = (40, 32),
        image_size: tuple[int, int] | None = None,
        points: int = 20,
    ) -> Path:
        pycolmap = import_pycolmap()
        rng = np.random.default_rng(0)
        root = tmp_path / name
        (root / "images").mkdir(parents=True)
        (root / "sparse" / "0").mkdir(parents=True)
        reconstruction = pycolmap.Reconstruction()
        camera = pycolmap.Camera(model=model, width=size[0], height=size[1], params=list(params), camera_id=1)
        reconstruction.add_camera_with_trivial_rig(camera)
        width, height = image_size or size
        for i in range(views):
            pose = np.eye(4)[:3]
            pose[:, 3] = rng.normal(size=3)
            image = pycolmap.Image(name=f"{i:03d}.png", camera_id=1, image_id=views - i)  # ids against the names
            reconstruction.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
            small = rng.integers(0, 256, (4, 5, 3), dtype=np.uint8)
            picture = cv2.resize(small, (width, height), interpolation=cv2.INTER_CUBIC)
            assert cv2.imwrite(str(root / "images" / f"{i:03d}.png"), picture)
        for xyz, rgb in zip(
            rng.normal(size=(points, 3)), rng.integers(0, 256, (points, 3), dtype=np.uint8), strict=True
        ):
            reconstruction.add_point3D(xyz, pycolmap.Track(), rgb)
        reconstruction.write_binary(str(root / "sparse" / "0"))
        return root

    return make
