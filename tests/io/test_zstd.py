from __future__ import annotations

from types import ModuleType

import pytest
from viewer_scenes import needs_zstd

from nsvq_lightning.io import FormatError, zstd

DATA = b"many equal bytes " * 100


@needs_zstd
def test_what_was_compressed_comes_back() -> None:
    frame = zstd.compress(DATA)
    assert len(frame) < len(DATA) / 10
    assert frame == zstd.compress(DATA)
    assert zstd.decompress(frame, len(DATA)) == DATA
    assert zstd.decompress(zstd.compress(b""), 0) == b""


@needs_zstd
@pytest.mark.parametrize("size", [0, len(DATA) - 1, len(DATA) + 1])
def test_another_size_is_refused(size: int) -> None:
    with pytest.raises(FormatError, match=f"does not hold the {size} bytes"):
        zstd.decompress(zstd.compress(DATA), size)


@needs_zstd
def test_damage_is_refused_wherever_it_is() -> None:
    frame = zstd.compress(DATA)
    for position in range(len(frame)):
        with pytest.raises(FormatError, match="damaged"):
            zstd.decompress(frame[:position], len(DATA))
        with pytest.raises(FormatError, match="damaged"):
            zstd.decompress(frame[:position] + bytes([frame[position] ^ 1]) + frame[position + 1 :], len(DATA))
    with pytest.raises(FormatError, match="damaged"):
        zstd.decompress(frame + b"more", len(DATA))


def test_without_zstandard_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> ModuleType:
        raise ImportError(name)

    monkeypatch.setattr(zstd, "import_module", missing)
    with pytest.raises(FormatError, match=r"needs Zstandard.* pip install 'nsvq-lightning\[spz\]'"):
        zstd.compress(DATA)
