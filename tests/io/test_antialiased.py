"""Files say whether a scene is to be rendered with anti-aliasing, or warn that they cannot."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from compressed_scenes import scene as coded

from nsvq_lightning.io.formats import FORMATS, read_scene, save


@pytest.mark.parametrize("suffix", FORMATS)
@pytest.mark.parametrize("antialiased", [False, True])
def test_files_keep_it_or_warn(
    suffix: str, antialiased: bool, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    scene = replace(coded(50), config={"antialiased": antialiased})
    save(scene, tmp_path / f"a{suffix}")
    keeps = suffix in (".nsvq", ".sog", ".spz")
    assert read_scene(tmp_path / f"a{suffix}").antialiased == (antialiased and keeps)
    assert ("switch it on in the viewer" in caplog.text) == (antialiased and not keeps)
